// The page as a whole: filters, choice, keys.

const DATA = JSON.parse(document.getElementById("data").textContent);
const FACES = decodeArray(DATA.faces, Uint32Array);
const FILTERS = ["search", "status", "verdict", "shortest", "longest", "frames"];

function filterValues() {
  return Object.fromEntries(FILTERS.map((name) => [name, document.getElementById(name).value]));
}

function show() {
  state.shown = filtered(DATA.fish, filterValues());
  document.getElementById("count").textContent = `${state.shown.length} of ${DATA.fish.length} fish`;
  drawTable();
  drawSummary(state.shown);
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
  drawRows(choose);
  drawDetail(fish);
}

function replaceFish(fish) {
  DATA.fish[DATA.fish.findIndex((one) => one.id === fish.id)] = fish;
  show();
  choose(fish.id);
}

// Shows the verdicts given since the page was made, also by others. What is open stays as it is.
let lastAnswer = "";
async function refresh() {
  const text = await fetch("reviewed.json").then((answer) => (answer.ok ? answer.text() : lastAnswer), () => lastAnswer);
  if (text === lastAnswer) return;
  lastAnswer = text;
  for (const fish of JSON.parse(text)) DATA.fish[DATA.fish.findIndex((one) => one.id === fish.id)] = fish;
  show();
}

function step(by) {
  const at = state.shown.findIndex((one) => one.id === state.chosen) + by;
  const fish = state.shown[Math.max(0, Math.min(state.shown.length - 1, at))];
  if (!fish) return;
  const table = document.getElementById("table");
  const top = state.shown.indexOf(fish) * ROW_PX;
  if (top < table.scrollTop || top + ROW_PX > table.scrollTop + table.clientHeight) table.scrollTop = top;
  choose(fish.id);
}

let waiting = 0;
document.getElementById("filters").oninput = () => {
  clearTimeout(waiting);
  waiting = setTimeout(() => { document.getElementById("table").scrollTop = 0; show(); }, 150);
};
document.getElementById("filters").onsubmit = (event) => event.preventDefault();
document.getElementById("table").onscroll = () => requestAnimationFrame(() => drawRows(choose));
document.getElementById("table").onkeydown = (event) => {
  const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (by) { event.preventDefault(); step(by); }
};
document.getElementById("software").textContent = `stream-dmr ${DATA.software}, template ${DATA.template}`;
document.getElementById("notes").replaceChildren(...DATA.notes.map((note) => element("li", { textContent: note })));
show();
if (DATA.reviewer !== null) {
  refresh();
  setInterval(refresh, 5000);
}
if (location.hash.startsWith("#fish-")) choose(Number(location.hash.slice(6)));
