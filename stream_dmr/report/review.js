// Verdicts: only where a server asks for them.

function reviewTools(fish, shots) {
  if (DATA.reviewer === null) return [];
  const said = element("p", { id: "said", textContent: "" });
  const send = async (verdict) => {
    const refuse = (why) => { said.className = "bad"; said.textContent = why; };
    try {
      const answer = await fetch("verdict", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ track_id: fish.track_id, ...verdict }) });
      const content = await answer.json();
      if (answer.ok) replaceFish(content);
      else refuse(content.error);
    } catch {
      refuse("Not saved: stream-dmr review has ended. Start it again, and open its new address.");
    }
  };
  const text = (id, placeholder, kind, name, label) => {
    const input = element("input", { id, placeholder, size: 14 });
    return element("span", { className: "group" }, input, element("button", { type: "button", id: `do-${kind}`, textContent: label, onclick: () => send({ kind, [name]: name === "duplicate_of" ? Number(input.value) : input.value }) }));
  };
  const points = movable(shots);
  return [element("div", { id: "verdicts" },
    element("button", { type: "button", id: "do-accept", textContent: "Accept", onclick: () => send({ kind: "accept" }) }),
    text("reason", "why", "reject", "reason", "Reject"),
    text("species-name", "species", "species", "species", "Set species"),
    text("duplicate-of", "fish", "duplicate", "duplicate_of", "Is a duplicate of"),
    element("button", { type: "button", id: "do-correct", textContent: "Save moved points", onclick: () => points.moved() ? send({ kind: "correct", ...points.moved() }) : (said.textContent = "Drag a head (red) or tail (blue) point first.") }),
    element("button", { type: "button", id: "do-withdraw", textContent: "Take all back", onclick: () => send({ kind: "withdraw" }) }),
    element("small", { textContent: `as ${DATA.reviewer}; head and tail points can be dragged` }), said)];
}

const REACH_PX = 24;  // on the screen: a finger is no needle

// Head and tail can be dragged; what was dragged last is what is saved, in pixels of its crop.
function movable(shots) {
  let last = null;
  for (const box of shots.querySelectorAll("svg")) {
    const ends = [...box.querySelectorAll('[data-name="head"], [data-name="tail"]')];
    const place = (end) => ({ x: end.cx.baseVal.value, y: end.cy.baseVal.value });
    const at = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(box.getScreenCTM().inverse());
    const away = (end, p) => Math.hypot(place(end).x - p.x, place(end).y - p.y) * box.getScreenCTM().a;
    let held = null, from = null;  // the point, and where it was gripped
    box.classList.add("moves");
    box.onpointerdown = (event) => {
      const p = at(event);
      const nearest = ends.reduce((one, other) => (away(one, p) <= away(other, p) ? one : other));
      if (away(nearest, p) > REACH_PX) return;
      held = nearest;
      from = { x: place(held).x - p.x, y: place(held).y - p.y };
      box.setPointerCapture(event.pointerId);
    };
    box.onpointermove = (event) => {
      if (!held) return;
      const p = at(event);
      held.setAttribute("cx", p.x + from.x);
      held.setAttribute("cy", p.y + from.y);
      last = box;
    };
    box.onpointerup = box.onpointercancel = () => { held = null; };
  }
  const at = (name) => { const p = last.querySelector(`[data-name="${name}"]`); return [p.cx.baseVal.value, p.cy.baseVal.value]; };
  return { moved: () => last && { frame_index: Number(last.dataset.frame), head: at("head"), tail: at("tail") } };
}
