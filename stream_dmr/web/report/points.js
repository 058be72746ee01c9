// Head and tail points that can be dragged to where they belong.

const GRAB_RADIUS_PX = 24;  // on the screen; a fingertip covers about as much

// Lets head and tail points be dragged. The frame that was dragged in last is saved, in crop pixels.
function makeDraggable(views) {
  let last = null;
  for (const box of views.querySelectorAll("svg")) {
    const ends = [...box.querySelectorAll('[data-name="head"], [data-name="tail"]')];
    const place = (end) => ({ x: end.cx.baseVal.value, y: end.cy.baseVal.value });
    const at = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(box.getScreenCTM().inverse());
    const distancePx = (end, p) => Math.hypot(place(end).x - p.x, place(end).y - p.y) * box.getScreenCTM().a;
    let grabbed = null, offset = null;  // the point, and where it was grabbed
    box.classList.add("draggable");
    box.onpointerdown = (event) => {
      const p = at(event);
      const nearest = ends.reduce((one, other) => (distancePx(one, p) <= distancePx(other, p) ? one : other));
      if (distancePx(nearest, p) > GRAB_RADIUS_PX) return;
      grabbed = nearest;
      offset = { x: place(grabbed).x - p.x, y: place(grabbed).y - p.y };
      box.setPointerCapture(event.pointerId);
    };
    box.onpointermove = (event) => {
      if (!grabbed) return;
      const p = at(event);
      grabbed.setAttribute("cx", p.x + offset.x);
      grabbed.setAttribute("cy", p.y + offset.y);
      last = box;
    };
    box.onpointerup = box.onpointercancel = () => { grabbed = null; };
  }
  const at = (name) => { const p = last.querySelector(`[data-name="${name}"]`); return [p.cx.baseVal.value, p.cy.baseVal.value]; };
  return { moved: () => last && { frame_index: Number(last.dataset.frame), head: at("head"), tail: at("tail") } };
}
