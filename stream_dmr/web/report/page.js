// The page as a whole: filters, choice, keys.

const DATA = JSON.parse(document.getElementById("data").textContent);
const FACES = decodeArray(DATA.faces, Uint32Array);
const NARROW = "(max-width: 900px)";
const FILTERS = ["search", "status", "verdict", "shortest", "longest", "frames"];

function filterValues() {
  return Object.fromEntries(FILTERS.map((name) => [name, document.getElementById(name).value]));
}

function show() {
  state.shown = filtered(DATA.fish, filterValues());
  document.getElementById("count").textContent = `${state.shown.length} of ${DATA.fish.length} fish`;
  drawTable();
  drawSummary(state.shown);
  if (isReview()) drawReviewBar();
  if (isReview() && !document.getElementById("plots-too").checked) return;  // quicker from fish to fish
  drawHistogram(state.shown);
  drawTime(state.shown, choose);
}

function drawTable() {
  state.shown = sorted(state.shown);
  drawHead(drawTable);
  drawRows(choose);
}

function choose(id) {
  const fish = DATA.fish.find((one) => one.id === id);
  if (!fish) return;
  state.chosen = id;
  if (!isReview()) history.replaceState(null, "", `#fish-${id}`);  // where a reload begins; a review goes on
  drawRows(choose);
  const drawn = drawDetail(fish);
  const panel = document.getElementById("detail");
  if (matchMedia(NARROW).matches) drawn.then(() => panel.scrollIntoView({ block: "start" }));
}

// Chooses a fish and brings its row into sight.
function showFish(fish) {
  const table = document.getElementById("table");
  const top = state.shown.indexOf(state.shown.find((one) => one.id === fish.id)) * ROW_PX;
  if (top >= 0 && (top < table.scrollTop || top + ROW_PX > table.scrollTop + table.clientHeight)) table.scrollTop = top;
  choose(fish.id);
}

function step(by) {
  const at = state.shown.findIndex((one) => one.id === state.chosen) + by;
  const fish = state.shown[Math.max(0, Math.min(state.shown.length - 1, at))];
  if (fish) showFish(fish);
}

let waiting = 0;
document.getElementById("filters").oninput = () => {
  clearTimeout(waiting);
  waiting = setTimeout(() => { document.getElementById("table").scrollTop = 0; show(); }, 150);
};
document.getElementById("filters").onsubmit = (event) => event.preventDefault();
document.getElementById("table").onscroll = () => requestAnimationFrame(() => drawRows(choose));
addEventListener("beforeprint", () => drawRows(choose, true));
addEventListener("afterprint", () => drawRows(choose));
document.getElementById("table").onkeydown = (event) => {
  const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (by) { event.preventDefault(); step(by); }
};
document.getElementById("software").textContent = `stream-dmr ${DATA.software}, template ${DATA.template}`;
for (const name of ["notes", "shapes"]) document.getElementById(name).replaceChildren(...DATA[name].map((line) => element("li", { textContent: line })));
show();
if (!DATA.fish.length) document.querySelector("#detail .hint").textContent = "There is no fish here.";
if (isReview()) startReview();
if (location.hash.startsWith("#fish-")) choose(Number(location.hash.slice(6)));
