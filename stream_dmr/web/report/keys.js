// Everything of a review by the keyboard.

const focusOn = (id) => () => { const input = document.getElementById(id); input?.focus(); input?.select(); };
const click = (id) => () => document.getElementById(id)?.click();
const KEYS = [
  ["a", "accept", click("do-accept")], ["r", "reject: type a reason, Enter", focusOn("reason")],
  ["s", "species: type its code or name, Enter", focusOn("species-name")], ["d", "duplicate of: its number, Enter", focusOn("duplicate-of")],
  ["f", "fate: type it, Enter", focusOn("fate-name")], ["c", "condition: type its code, Enter", focusOn("condition-code")],
  ["u", "undo your last verdict", () => send({ kind: "undo" })], ["n", "next without a decision", click("do-next")],
  ["j", "next fish", () => step(1)], ["k", "fish before", () => step(-1)],
  [" ", "play, pause", () => togglePlay()], ["ArrowLeft", "frame before", () => stepFrame(-1)], ["ArrowRight", "next frame", () => stepFrame(1)],
  ["<", "earlier", () => shiftClip(-1)], [">", "later", () => shiftClip(1)], ["z", "zoom", () => toggleZoom()], ["o", "outlines", () => toggleOutlines()],
  ["x", "another fish from this frame on", click("do-split")], ["m", "goes on as: number of the other fish, Enter", focusOn("merge-into")],
  ["b", "add a missed fish: draw boxes, Enter", click("do-add")], ["p", "save moved points", click("do-correct")],
  ["?", "these keys", () => document.getElementById("keys").toggleAttribute("open")],
];
const REPEATED = ["j", "k", "ArrowLeft", "ArrowRight", "<", ">"];
const KEY_NAMES = { " ": "space", ArrowLeft: "\u2190", ArrowRight: "\u2192" };

function drawKeys() {
  document.getElementById("key-list").replaceChildren(...KEYS.flatMap(([key, what]) => [element("kbd", { textContent: KEY_NAMES[key] ?? key }), `${what}  `]));
}

function onKey(event) {
  const isTyping = event.target.matches("input:not([type=range]):not([type=checkbox]), select, textarea");
  if (event.key === "Escape") {
    if (isDrawing()) stopDrawing();
    return event.target.blur();
  }
  if (isTyping || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === "Enter" && isDrawing() && event.target.id !== "do-cancel") { event.preventDefault(); return measureDrawn(); }
  const known = KEYS.find(([key]) => key === event.key || key === event.key.toLowerCase());
  if (!known || (event.key === " " && event.target.matches("button, summary, [type=checkbox]"))) return;
  event.preventDefault();
  if (event.repeat && !REPEATED.includes(known[0])) return;  // a key that is held judges one fish
  known[2]();
}
