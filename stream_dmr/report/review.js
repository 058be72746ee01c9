// The tools for verdicts: only where the page comes from `stream-dmr review`.

function reviewTools(fish, views) {
  if (DATA.reviewer === null) return [];
  const message = element("p", { id: "message", textContent: "" });
  const send = async (verdict) => {
    const showError = (text) => { message.className = "bad"; message.textContent = text; };
    try {
      const answer = await fetch("verdict", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ track_id: fish.track_id, ...verdict }) });
      const content = await answer.json();
      if (answer.ok) replaceFish(content);
      else showError(content.error);
    } catch {
      showError("Not saved: stream-dmr review has ended. Start it again, and open its new address.");
    }
  };
  const text = (id, placeholder, kind, name, label) => {
    const input = element("input", { id, placeholder, size: 14 });
    return element("span", { className: "group" }, input, element("button", { type: "button", id: `do-${kind}`, textContent: label, onclick: () => send({ kind, [name]: name === "duplicate_of" ? Number(input.value) : input.value }) }));
  };
  const points = makeDraggable(views);
  return [element("div", { id: "verdicts" },
    element("button", { type: "button", id: "do-accept", textContent: "Accept", onclick: () => send({ kind: "accept" }) }),
    text("reason", "reason", "reject", "reason", "Reject"),
    text("species-name", "species", "species", "species", "Set species"),
    text("duplicate-of", "fish", "duplicate", "duplicate_of", "Is a duplicate of"),
    element("button", { type: "button", id: "do-correct", textContent: "Save moved points", onclick: () => points.moved() ? send({ kind: "correct", ...points.moved() }) : (message.textContent = "Drag a head (red) or tail (blue) point first.") }),
    element("button", { type: "button", id: "do-withdraw", textContent: "Withdraw verdicts", onclick: () => send({ kind: "withdraw" }) }),
    element("small", { textContent: `as ${DATA.reviewer}; head and tail points can be dragged` }), message)];
}

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
