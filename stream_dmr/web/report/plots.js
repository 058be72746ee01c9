// Plots of all fish that are shown, and the summary of them.

const PLOT_CONFIG = { displayModeBar: false, responsive: true };
const BLUE = "#1668a8", ORANGE = "#d55e00";

const NOT_COUNTED = ["reject", "duplicate", "merge"];

function countedFish(fish) {
  return fish.filter((f) => lengthOf(f) !== null && !NOT_COUNTED.includes(f.verdict));
}

// How often each name comes, the most frequent first: "31 landed, 4 dropped".
function countOf(names) {
  const counts = new Map();
  for (const name of names) counts.set(name, (counts.get(name) ?? 0) + 1);
  return [...counts].sort((a, b) => b[1] - a[1]).map(([name, count]) => `${count} ${name}`).join(", ");
}

function drawSummary(fish) {
  const lengths = countedFish(fish).map((f) => lengthOf(f) / 10).sort((a, b) => a - b);
  const tiles = [[fish.length, "fish"], [lengths.length, "with a length, not rejected"]];
  if (lengths.length) {
    const mean = lengths.reduce((sum, x) => sum + x, 0) / lengths.length;
    const sd = Math.sqrt(lengths.reduce((sum, x) => sum + (x - mean) ** 2, 0) / (lengths.length - 1));
    tiles.push([`${mean.toFixed(1)} cm`, "mean"],
      ...(lengths.length > 1 ? [[`${sd.toFixed(1)} cm`, "standard deviation"]] : []),  // of one fish there is none
      [`${quantile(lengths, 0.5).toFixed(1)} cm`, "median"],
      [`${quantile(lengths, 0.25).toFixed(1)} to ${quantile(lengths, 0.75).toFixed(1)} cm`, "25 % to 75 %"],
      [`${lengths[0].toFixed(1)} to ${lengths.at(-1).toFixed(1)} cm`, "shortest to longest"]);
  }
  for (const [name, said] of [["species", (f) => f.species_code ?? (f.species === DATA.template ? null : f.species)], ["fate", (f) => f.fate]]) {
    const counted = countOf(fish.filter((f) => !NOT_COUNTED.includes(f.verdict)).map(said).filter(Boolean));
    if (counted) tiles.push([counted, name]);
  }
  const weights = countedFish(fish).map((f) => f.weight_kg).filter((w) => w !== null);
  if (weights.length) tiles.push([`${weights.reduce((sum, w) => sum + w, 0).toFixed(1)} kg`, `of ${weights.length} fish, W = a L^b`]);
  const legal = countedFish(fish).map((f) => f.is_legal_size).filter((is) => is !== null);
  if (legal.length) tiles.push([`${legal.filter(Boolean).length} of ${legal.length}`, `from ${DATA.fisheries.legal_cm} cm: legal size`]);
  document.getElementById("summary").replaceChildren(...tiles.map(([value, name]) => element(
    "div", { className: "tile" }, element("b", { textContent: value }), element("span", { textContent: name }))));
}

function quantile(sorted, p) {
  const at = p * (sorted.length - 1);
  const low = Math.floor(at);
  return sorted[low] + (at - low) * ((sorted[low + 1] ?? sorted[low]) - sorted[low]);
}

// Gaussian kernel density with Silverman's bandwidth, 0.9 min(sd, iqr / 1.34) n^(-1/5).
function density(sorted, at) {
  const n = sorted.length;
  const mean = sorted.reduce((sum, x) => sum + x, 0) / n;
  const sd = Math.sqrt(sorted.reduce((sum, x) => sum + (x - mean) ** 2, 0) / Math.max(1, n - 1));
  const spread = Math.min(sd, (quantile(sorted, 0.75) - quantile(sorted, 0.25)) / 1.34) || sd || 1;
  const h = 0.9 * spread * n ** -0.2;
  return at.map((x) => sorted.reduce((sum, y) => sum + Math.exp(-0.5 * ((x - y) / h) ** 2), 0) / (n * h * Math.sqrt(2 * Math.PI)));
}

function layout(title, x, y) {
  return {
    title: { text: title, font: { size: 13 }, x: 0.02 },
    margin: { l: 46, r: 12, t: 28, b: 36 }, font: { size: 11 }, showlegend: false,
    xaxis: { title: { text: x }, zeroline: false }, yaxis: { title: { text: y }, zeroline: false, rangemode: "normal" },
  };
}

function showNoLengths(drawn) {
  drawn.xaxis.visible = drawn.yaxis.visible = false;
  drawn.annotations = [{ text: "no lengths", showarrow: false, xref: "paper", yref: "paper", x: 0.5, y: 0.5 }];
}

function drawHistogram(fish) {
  const lengths = countedFish(fish).map((f) => lengthOf(f) / 10).sort((a, b) => a - b);
  const low = lengths[0] ?? 0, high = lengths.at(-1) ?? 1;
  const width = [1, 2, 5, 10, 20, 50].find((w) => (high - low) / w <= Math.min(30, Math.max(6, 2 * Math.sqrt(lengths.length)))) ?? 100;
  const first = Math.floor(low / width) * width;
  const counts = new Array(Math.floor((high - first) / width) + 1).fill(0);
  for (const x of lengths) counts[Math.floor((x - first) / width)] += 1;
  const traces = [{ type: "bar", x: counts.map((_, k) => first + (k + 0.5) * width), y: counts, width, marker: { color: "#9cc3e0", line: { color: "#fff", width: 1 } }, hovertemplate: `%{y} fish, %{x} cm \u00b1 ${width / 2}<extra></extra>` }];
  if (lengths.length > 1) {
    const at = Array.from({ length: 200 }, (_, k) => first - width + (k / 199) * (high - first + 3 * width));
    traces.push({ type: "scatter", mode: "lines", x: at, y: density(lengths, at).map((d) => d * lengths.length * width), line: { color: BLUE, width: 2 }, hoverinfo: "skip" });
  }
  const drawn = layout("Length frequency (bars) and kernel density (line)", "cm", "fish");
  if (Math.max(...counts) < 6) drawn.yaxis.dtick = 1;
  if (!lengths.length) showNoLengths(drawn);
  const limit = DATA.fisheries.legal_cm;
  if (fish.some((f) => f.is_legal_size !== null)) drawn.shapes = [{ type: "line", x0: limit, x1: limit, yref: "paper", y0: 0, y1: 1, line: { color: ORANGE, dash: "dot" } }];
  Plotly.react("histogram", traces, drawn, PLOT_CONFIG);
}

function drawTime(fish, onChoose) {
  const measured = fish.filter((f) => lengthOf(f) !== null);
  const start = DATA.began_s;
  const span = Math.max(...DATA.fish.map((f) => f.time_s)) - start;
  const [unit, seconds] = span < 300 ? ["s", 1] : span < 18000 ? ["minutes", 60] : ["hours", 3600];
  const at = (f) => (f.time_s - start) / seconds;
  const bars = { x: [], y: [] };
  for (const f of measured) {
    const interval = intervalOf(f);
    if (interval === null) continue;
    bars.x.push(at(f), at(f), null);
    bars.y.push(interval[0] / 10, interval[1] / 10, null);
  }
  const counts = new Set(countedFish(fish));
  const traces = [
    { type: "scatter", mode: "lines", ...bars, line: { color: "#c4d4e1", width: 1 }, hoverinfo: "skip" },
    { type: "scatter", mode: "markers", x: measured.map(at), y: measured.map((f) => lengthOf(f) / 10), customdata: measured.map((f) => f.id), text: measured.map((f) => `${f.track_id} ${f.video && `of ${f.video}`}`),
      marker: { color: measured.map((f) => (counts.has(f) ? BLUE : "#c0c0c0")), size: 6 }, hovertemplate: "fish %{text}<br>%{y:.1f} cm<extra></extra>" },
  ];
  const drawn = layout("Fish over time, with 95 % intervals", `${unit} from the first frame`, "cm");
  if (!measured.length) showNoLengths(drawn);
  Plotly.react("time", traces, drawn, PLOT_CONFIG).then((plot) => {
    plot.removeAllListeners("plotly_click");
    plot.on("plotly_click", (event) => event.points[0].customdata && onChoose(event.points[0].customdata));
  });
}
