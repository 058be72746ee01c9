// The tools for verdicts: only where the page comes from `stream-dmr review`.

const DECISIONS = ["accept", "reject", "duplicate", "merge"];  // after which the next fish is shown

// The frames, views and mesh of a fish.
async function detailOfServer(fish) {
  return fetch(`fish.json?run=${fish.run}&fish=${fish.track_id}`).then((answer) => answer.json());
}

// An image that is loaded after the others before it: drawn all at once they would hold up the clip.
let lastThumbnail = Promise.resolve(), numThumbnails = 0;
function thumbnailOfServer(fish) {
  const image = element("img", { alt: "" });
  lastThumbnail = lastThumbnail.then(() => new Promise((done) => {
    if (!image.isConnected) { fish.image = null; return done(); }  // scrolled past
    image.onload = image.onerror = done;
    image.src = `thumbnail?run=${fish.run}&fish=${fish.track_id}&number=${numThumbnails++}`;  // else that of before an edit
  }));
  return image;
}

// What a reviewer sees of a fish before everything else. What was said last stays in sight.
function reviewParts(fish, views) {
  const said = document.getElementById("message");
  const tools = reviewTools(views);
  if (said) tools.lastChild.replaceWith(said);
  return [CLIP_PANE, tools];
}

function showParts(fish) {
  openClip(fish, 0);
  setTimeout(() => {  // plots are slow: they come when the reviewer stays
    if (state.chosen !== fish.id) return;
    drawFrames(FRAMES_PLOT, fish.detail.frames);
    drawMesh(MESH_PLOT, fish.detail.mesh, fish.unit);
  }, 400);
}

function chosenFish() { return DATA.fish.find((one) => one.id === state.chosen) ?? null; }

function say(text, isBad = false) {
  const message = document.getElementById("message");
  if (message) { message.className = isBad ? "bad" : ""; message.textContent = text; }
}

// The next fish without a decision in the list as it is sorted, from a fish on; null where all have one.
function nextUnreviewed(id) {
  const at = state.shown.findIndex((one) => one.id === id);
  const order = [...state.shown.slice(at + 1), ...state.shown.slice(0, at + 1)];
  return order.find((one) => one.verdict === null && one.id !== id) ?? null;
}

// Shows it; what there is to say where there is none.
function goToNext() {
  const next = nextUnreviewed(state.chosen);
  if (next) { showFish(next); return ""; }
  const left = chosenFish()?.verdict === null ? 1 : 0;
  return left ? "This is the last fish without a decision." : `All ${state.shown.length} fish have a decision.`;
}

// What an undo takes back stands on its button.
function undoLabel() { return bindKey(DATA.review.undo ? `Undo ${DATA.review.undo}` : "Undo", "u"); }

let deciding = null;  // the fish whose decision is on its way
let isRefused = false;  // the last act: an undo after it would take back the one before, unseen

function refuse(text) {
  isRefused = true;
  say(text, true);
}

async function send(verdict) {
  const fish = chosenFish();
  if (!fish && verdict.kind !== "undo") return;
  if (isRefused && verdict.kind === "undo") {
    isRefused = false;
    return say(`Nothing was saved, so nothing is taken back.${DATA.review.undo && ` Once more takes back: ${DATA.review.undo}.`}`);
  }
  const decides = DECISIONS.includes(verdict.kind);
  if (decides && deciding === fish.id) return say("Saving ...");  // not a second time
  if (decides) deciding = fish.id;
  const seenBefore = new Set(DATA.seen);  // `refresh` may bring a new fish before the answer does
  let answered;
  try {
    const answer = await fetch("verdict", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ run: fish?.run ?? 0, track_id: fish?.track_id ?? 0, ...verdict }) });
    if (!answer.ok && answer.status !== 409) return refuse((await answer.text()).trim());
    answered = await answer.json();
  } catch {
    return refuse("Not saved: stream-dmr review has ended. Start it again, and open its new address.");
  } finally {
    if (decides && deciding === fish.id) deciding = null;
  }
  if (answered.question) return confirm(answered.question) ? send({ ...verdict, sure: true }) : refuse("Not saved.");
  const { rows, said } = answered;
  isRefused = false;
  DATA.review.undo = answered.undo;
  document.getElementById("do-undo")?.replaceChildren(...undoLabel());
  takeRows(rows);
  show();
  if (decides && document.getElementById("goes-on").checked) return say(`${said}. ${goToNext()}`);
  const wanted = verdict.kind === "add" ? rows.find((row) => !seenBefore.has(row.id)) : verdict.kind === "undo" ? rows.find((row) => !row.gone) : null;
  const shown = wanted ?? chosenFish() ?? DATA.fish[0];
  for (const row of rows) DATA.seen.add(row.id);
  if (shown) showFish(shown);
  say(`${said}.`);
}

// Rows of the server in place of those of the page; a fish may be new, or gone.
function takeRows(rows) {
  for (const row of rows) {
    const at = DATA.fish.findIndex((one) => one.id === row.id), old = DATA.fish[at];
    const isSame = old && ["origin", "frames_seen", "first_frame", "last_frame", "corrected_length_mm"].every((name) => old[name] === row[name]);
    if (row.gone) { if (at >= 0) DATA.fish.splice(at, 1); continue; }
    if (isSame) row.detail = old.detail;
    if (isSame && old.image?.src) row.image = old.image;  // one that still waits may be dropped as scrolled past
    if (at >= 0) DATA.fish[at] = row;
    else DATA.fish.push(row);
  }
}

function typed(id) { return document.getElementById(id).value.trim(); }

// What was typed as a code or a name of the list, as the list says it; else as it was typed.
function speciesNamed(text) {
  const typed = text.toLowerCase();
  const known = DATA.review.species.find((one) => [one.code, one.name, one.scientific].some((name) => name.toLowerCase() === typed));
  return known ? known.value : text;
}

function reviewTools(views) {
  const button = (kind, key, label, onclick) => element("button", { type: "button", id: `do-${kind}`, onclick }, ...bindKey(label, key));
  const group = (input, ...more) => element("span", { className: "group" }, input, ...more);
  const field = (id, placeholder, kind, other = {}) => {
    const input = element("input", { id, placeholder, size: 12, autocomplete: "off", "aria-label": `${kind}: ${placeholder}`, ...other });
    input.onkeydown = (event) => { if (event.key === "Enter") { event.preventDefault(); document.getElementById(`do-${kind}`).click(); input.blur(); } };
    return input;
  };
  const points = makeDraggable(views);
  const canEdit = !DATA.review.blind;
  return element("div", { id: "verdicts" },
    button("accept", "a", "Accept", () => send({ kind: "accept" })),
    group(field("reason", "reason", "reject"), button("reject", "r", "Reject", () => send({ kind: "reject", reason: typed("reason") }))),
    group(field("species-name", "code or name", "species", { list: "species-list" }), button("species", "s", "Set species", () => send({ kind: "species", species: speciesNamed(typed("species-name")) }))),
    group(field("fate-name", "name", "fate", { list: "fate-list" }), button("fate", "f", "Set fate", () => send({ kind: "fate", fate: typed("fate-name") }))),
    group(field("condition-code", "code", "condition", { list: "condition-list" }), button("condition", "c", "Set condition", () => send({ kind: "condition", condition: typed("condition-code") }))),
    group(field("duplicate-of", "fish", "duplicate", { inputMode: "numeric" }), button("duplicate", "d", "Duplicate of", () => send({ kind: "duplicate", duplicate_of: Number(typed("duplicate-of")) }))),
    ...(canEdit ? [
      group(field("merge-into", "fish", "merge", { inputMode: "numeric" }), button("merge", "m", "Goes on as", () => send({ kind: "merge", other_fish: Number(typed("merge-into")) }))),
      button("split", "x", "Another fish from this frame on", () => currentFrame() && send({ kind: "split", frame_index: currentFrame().frame })),
      button("add", "b", "Add a missed fish", startDrawing)] : []),
    element("button", { type: "button", id: "do-correct", onclick: () => points.moved() ? send({ kind: "correct", ...points.moved() }) : say("Drag a head (red) or tail (blue) point first.") }, ...bindKey("Save moved points", "p")),
    element("button", { type: "button", id: "do-undo", onclick: () => send({ kind: "undo" }) }, ...undoLabel()),
    button("next", "n", "Next unreviewed", () => say(goToNext())),
    element("button", { type: "button", id: "do-withdraw", textContent: "Withdraw verdicts", onclick: () => send({ kind: "withdraw" }) }),
    element("div", { id: "drawing", hidden: true }, element("span", { id: "drawing-text" }),
      element("button", { type: "button", id: "do-measure", onclick: measureDrawn }, ...bindKey("Measure it", "Enter")), element("button", { type: "button", id: "do-cancel", onclick: stopDrawing }, ...bindKey("Cancel", "Esc"))),
    element("p", { id: "message", role: "status", textContent: "" }));
}

async function measureDrawn() {
  if (!drawing.boxes.size) return say("Draw a box around the fish first.", true);
  say("Measuring ...");
  const boxes = [...drawing.boxes.values()];
  stopDrawing();
  await send({ kind: "add", boxes });
}

// Above the list: who reviews, how far it is, and the keys.
function drawReviewBar() {
  const { reviewer, blind, sample } = DATA.review;
  const left = DATA.fish.filter((one) => one.verdict === null).length;
  const what = [`${reviewer}${blind ? ", blind second reading" : ""}`, sample ? `random sample of ${sample.size} (seed ${sample.seed})` : "", `${left} of ${DATA.fish.length} without a decision`].filter(Boolean);
  document.getElementById("progress").textContent = what.join("; ");
}

// Shows the verdicts given since the page was made, also by others. What is open stays as it is.
let lastAnswer = "";
async function refresh() {
  const text = await fetch("reviewed.json").then((answer) => (answer.ok ? answer.text() : lastAnswer), () => lastAnswer);
  if (text === lastAnswer) return;
  lastAnswer = text;
  const rows = JSON.parse(text);
  takeRows(rows);
  for (const row of rows) DATA.seen.add(row.id);
  show();
}

function startReview() {
  DATA.seen = new Set(DATA.fish.map((one) => one.id));
  document.body.classList.add("review");
  document.getElementById("review-bar").hidden = false;
  document.getElementById("species-list").replaceChildren(...DATA.review.species.map((one) => element("option", { value: one.name, label: `${one.code}, ${one.scientific}` })));
  document.getElementById("fate-list").replaceChildren(...DATA.fates.map((value) => element("option", { value })));
  document.getElementById("condition-list").replaceChildren(...Object.entries(DATA.conditions).map(([value, label]) => element("option", { value, label })));
  document.getElementById("plots-too").onchange = (event) => { document.body.classList.toggle("with-plots", event.target.checked); show(); };
  drawKeys();
  addEventListener("keydown", onKey);
  refresh();
  setInterval(refresh, 5000);
  const first = state.shown.find((one) => one.verdict === null) ?? state.shown[0];
  if (first && !location.hash) choose(first.id);
}
