// The panel of one fish: best frames, every frame's length, the mesh. Its data is parsed when it opens.

const SVG = "http://www.w3.org/2000/svg";
// One plot of each kind for all fish, since a new one takes longer than new data in an old one.
const FRAMES_PLOT = element("div", { className: "plot" });
const MESH_PLOT = element("div", { className: "mesh-plot" });
const NO_DETAIL = '{"frames": [], "views": [], "mesh": null}';
const POINTS = [["head", "#ff3c3c"], ["center", "#ffffff"], ["tail", "#3ca0ff"]];

function svg(tag, attributes, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

function viewFigure(view, fish) {
  const s = view.size;
  const box = svg("svg", { viewBox: `-0.5 -0.5 ${s} ${s}`, "data-frame": view.frame },
    svg("image", { href: view.uri, x: -0.5, y: -0.5, width: s, height: s, preserveAspectRatio: "none" }),
    ...view.mask.map((points) => svg("polygon", { points, class: "mask" })),
    ...view.mesh.map((points) => svg("polygon", { points, class: "mesh" })),
    ...POINTS.map(([name, fill], k) => svg("circle", { cx: view.keypoints[k][0], cy: view.keypoints[k][1], r: s / 55, fill, class: "point", "data-name": name }, svg("title", {}, name))));
  const row = fish.detail.frames.find((frame) => frame[0] === view.frame);
  const caption = row ? `frame ${view.frame}, ${row[2] === null ? "" : `${cm(row[2])} cm, `}IoU ${row[6] ?? "-"}${row[4] ? "" : `, refused: ${row[5]}`}${view.moved ? ", points moved" : ""}` : `frame ${view.frame}`;
  const figure = element("figure", {}, box, element("figcaption", {}, element("small", { textContent: caption }),
    element("button", { type: "button", textContent: "larger", onclick: () => figure.classList.toggle("large") })));
  return figure;
}

function intervalText(fish) {
  const interval = intervalOf(fish);
  return interval && `95 % interval ${interval.map((mm) => cm(mm)).join(" to ")} cm`;
}

function factList(fish) {
  const run = DATA.runs[fish.run_id] ?? {};
  const reasons = Object.entries(fish.refused).map(([reason, count]) => `${reason} (${count})`).join(", ");
  const legal = fish.is_legal_size === null ? "" : fish.is_legal_size ? "yes" : "no";
  const rows = [
    ["length", fish.length_mm === null ? fish.status : `${cm(fish.length_mm)} cm, 95 % interval ${cm(fish.ci95_low_mm)} to ${cm(fish.ci95_high_mm)} cm`],
    ["corrected", fish.corrected_length_mm === null ? "" : [`${cm(fish.corrected_length_mm)} cm`, intervalText(fish)].filter(Boolean).join(", ")],
    ["fork, total", fish.fork_length_mm === null ? "" : `${cm(fish.fork_length_mm)} cm, ${cm(fish.total_length_mm)} cm`],
    ["whole cm", fish.length_cm ?? ""],
    ["weight", fish.weight_kg === null ? "" : `${fish.weight_kg.toFixed(2)} kg (${fish.weight_source})`],
    ["legal size", legal],
    ["frames", `${fish.frames_used} used of ${fish.frames_seen}, ${fish.first_frame} to ${fish.last_frame}`],
    ["refused", reasons], ["flags", fish.flags.join(", ")],
    ["frames chosen by", { add: "a reviewer: added", split: "a reviewer: split", merge: "a reviewer: merged" }[fish.origin] ?? ""],
    ["verdict", [VERDICTS[fish.verdict], fish.verdict_reason, fish.duplicate_of === null ? null : `${fish.verdict === "merge" ? "into" : "of"} fish ${fish.duplicate_of}`, fish.reviewer && `by ${fish.reviewer}, ${new Date(fish.reviewed_ns / 1e6).toISOString().slice(0, 16)} UTC`].filter(Boolean).join(", ")],
    ["species", [fish.species, fish.species_code, fish.species_share === null ? null : `${Math.round(100 * fish.species_share)} %`].filter(Boolean).join(", ")],
    ["fate", [fish.fate, fish.fate_share === null ? null : `${Math.round(100 * fish.fate_share)} % of the body`].filter(Boolean).join(", ")],
    ["condition", fish.condition && `${fish.condition}, ${DATA.conditions[fish.condition]}`],
    ["when, where", [fish.time_utc, placeOf(fish)].filter(Boolean).join(", ")], ["vessel, trip, haul", [fish.vessel, fish.trip, fish.haul].filter(Boolean).join(", ")],
    ["source", run.source], ["software", run.software_version], ["config", run.config_sha256], ["calibration", run.calibration_sha256], ["template", run.template_sha256],
  ];
  return element("dl", {}, ...rows.filter(([, value]) => value !== "" && value !== undefined && value !== null)
    .flatMap(([name, value]) => [element("dt", { textContent: name }), element("dd", { textContent: value })]));
}

function placeOf(fish) {
  if (fish.latitude === null) return fish.position_gap_s === null ? "" : `no positions for ${fish.position_gap_s.toFixed(0)} s around it`;
  const side = (value, letters) => `${Math.abs(value).toFixed(4)}° ${letters[value < 0 ? 1 : 0]}`;
  const knots = fish.speed_knots === null ? "" : `, ${fish.speed_knots.toFixed(1)} kn`;
  return `${side(fish.latitude, "NS")} ${side(fish.longitude, "EW")}${knots}`;
}

async function drawDetail(fish) {
  const panel = document.getElementById("detail");
  fish.detail ??= isReview() ? await detailOfServer(fish) : JSON.parse(document.getElementById(`fish-${fish.id}`)?.textContent ?? NO_DETAIL);
  if (state.chosen !== fish.id) return;
  const views = element("div", { className: "views" }, ...fish.detail.views.map((view) => viewFigure(view, fish)));
  const overlay = element("input", { type: "checkbox", checked: true, onchange: () => views.classList.toggle("plain", !overlay.checked) });
  panel.replaceChildren(
    element("h2", { textContent: `Fish ${fish.track_id}${fish.video && ` of ${fish.video}`}: ${lengthText(fish)}` }),
    ...(isReview() ? reviewParts(fish, views) : []),
    element("label", {}, overlay, " mask (yellow), mesh (green), head (red), center, tail (blue)"),
    views, element("div", { className: "pair" }, FRAMES_PLOT, MESH_PLOT), factList(fish));
  if (panel.dataset.fish !== String(fish.id)) panel.scrollTop = 0;
  panel.dataset.fish = fish.id;
  if (isReview()) return showParts(fish);
  drawFrames(FRAMES_PLOT, fish.detail.frames);
  setTimeout(() => state.chosen === fish.id && drawMesh(MESH_PLOT, fish.detail.mesh, fish.unit));  // last, since it is slow
}

function drawFrames(place, rows) {
  const known = rows.filter((row) => row[2] !== null);
  const running = rows.filter((row) => row[7] !== null);
  const part = (used) => known.filter((row) => Boolean(row[4]) === used);
  const marks = (used, marker) => ({
    type: "scatter", mode: "markers", x: part(used).map((row) => row[0]), y: part(used).map((row) => row[2] / 10), marker,
    ...(used && { error_y: { type: "data", array: part(used).map((row) => (row[3] ?? 0) / 10), thickness: 1, width: 0, color: "#9aa7b3" } }),
    text: part(used).map((row) => (row[4] ? `IoU ${row[6]}` : `refused: ${row[5]}`)), hovertemplate: "frame %{x}: %{y:.1f} cm<br>%{text}<extra></extra>",
  });
  const x = running.map((row) => row[0]);
  const heights = [...known.map((row) => row[2]), ...running.flatMap((row) => row.slice(8))];
  const [low, high] = [Math.min(...heights) / 10, Math.max(...heights) / 10];
  const drawn = layout("Frames (x: refused), estimate, 95 %", "frame", "cm");
  if (!heights.length) showNoLengths(drawn);
  else drawn.yaxis.range = [low - 0.1 * (high - low) - 0.5, high + 0.1 * (high - low) + 0.5];
  Plotly.react(place, [
    { type: "scatter", mode: "lines", x: [...x, ...[...x].reverse()], y: [...running.map((row) => row[9] / 10), ...running.map((row) => row[8] / 10).reverse()], fill: "toself", fillcolor: "rgba(22,104,168,.15)", line: { width: 0 }, hoverinfo: "skip" },
    { type: "scatter", mode: "lines", x, y: running.map((row) => row[7] / 10), line: { color: BLUE, width: 2 }, hovertemplate: "after frame %{x}: %{y:.1f} cm<extra></extra>" },
    marks(true, { color: BLUE, size: 6 }), marks(false, { color: ORANGE, size: 7, symbol: "x" }),
  ], drawn, PLOT_CONFIG);
}

function decodeArray(text, kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new kind(bytes.buffer);
}

function drawMesh(place, mesh, unit) {
  if (!mesh) return Plotly.purge(place);
  const points = decodeArray(mesh.points, Int16Array);
  const axis = (k, from, to) => Array.from({ length: to - from }, (_, n) => points[3 * (from + n) + k] * mesh.step);
  const corner = (k) => Array.from(FACES.filter((_, n) => n % 3 === k));
  const [n, all] = [mesh.vertices, points.length / 3];
  const scene = { aspectmode: "data", camera: { up: { x: 0, y: -1, z: 0 }, eye: { x: 0.4, y: -0.6, z: -2.5 } }, ...Object.fromEntries(["x", "y", "depth"].map((name, k) => [["xaxis", "yaxis", "zaxis"][k], { title: { text: `${name} ${unit}` } }])) };
  Plotly.react(place, [
    { type: "mesh3d", x: axis(0, 0, n), y: axis(1, 0, n), z: axis(2, 0, n), i: corner(0), j: corner(1), k: corner(2), color: "#7fb2d6", flatshading: false, opacity: 0.75, lighting: { ambient: 0.5, diffuse: 0.8 }, hoverinfo: "skip" },
    { type: "scatter3d", mode: "lines", x: axis(0, n, all), y: axis(1, n, all), z: axis(2, n, all), line: { color: ORANGE, width: 6 }, hoverinfo: "skip" },
  ], { margin: { l: 0, r: 0, t: 24, b: 0 }, scene, showlegend: false, title: { text: "Mesh of the best frame", font: { size: 13 }, x: 0.02 } }, PLOT_CONFIG);
}
