"use strict";
// The list of fish: only the rows in sight are in the page, so thousands scroll as easily as ten.

const ROW_PX = 76;
const COLUMNS = [
  { title: "", key: null },
  { title: "Fish", key: (f) => f.id },
  { title: "Length", key: (f) => lengthOf(f) ?? -1 },
  { title: "Frames", key: (f) => f.frames_used },
  { title: "Refused", key: (f) => f.frames_seen - f.frames_used },
  { title: "Flags", key: (f) => f.flags.length },
  { title: "Verdict", key: (f) => VERDICTS[f.verdict] ?? "" },
];

const state = { shown: [], column: 1, descending: false, chosen: null };

function isReview() { return DATA.review !== null; }

function lengthOf(fish) {
  return fish.corrected_length_mm ?? fish.length_mm;
}

// Low and high end of the 95 % interval, mm: of the correction where there is one; null without any.
function intervalOf(fish) {
  const [mm, std] = [fish.corrected_length_mm, fish.corrected_length_std_mm];
  if (mm !== null) return std === null ? null : [mm - 1.96 * std, mm + 1.96 * std];
  return fish.ci95_low_mm === null ? null : [fish.ci95_low_mm, fish.ci95_high_mm];
}

function cm(mm, digits = 1) {
  return mm === null || mm === undefined ? "-" : (mm / 10).toFixed(digits);
}

function lengthText(fish) {
  return lengthOf(fish) === null ? "no length" : `${cm(lengthOf(fish))} cm`;
}

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in made && name !== "list") made[name] = value;  // `list` can only be set as an attribute
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

function filtered(all, wanted) {
  const words = wanted.search.toLowerCase().split(/\s+/).filter(Boolean);
  return all.filter((f) => {
    const length = lengthOf(f);
    const text = `${f.track_id} ${f.video} ${f.haul} ${f.trip} ${f.vessel} ${f.species} ${f.species_code ?? ""} ${f.fate ?? ""} ${f.condition ?? ""} ${f.status} ${VERDICTS[f.verdict] ?? ""} ${f.verdict_reason ?? ""} ${f.flags.join(" ")} ${Object.keys(f.refused).join(" ")}`.toLowerCase();
    return words.every((word) => (/^\d+$/.test(word) ? String(f.track_id) === word || text.includes(word) : text.includes(word)))
      && (wanted.status !== "measured" || length !== null)
      && (wanted.status !== "not" || length === null)
      && (wanted.status !== "flagged" || f.flags.length > 0)
      && (wanted.verdict === "" || verdictOf(f).includes(wanted.verdict))
      && (wanted.shortest === "" || (length !== null && length >= 10 * wanted.shortest))
      && (wanted.longest === "" || (length !== null && length <= 10 * wanted.longest))
      && (wanted.frames === "" || f.frames_used >= Number(wanted.frames));
  });
}

const VERDICTS = { accept: "accepted", reject: "rejected", duplicate: "duplicate", merge: "merged" };

function verdictOf(fish) {
  return [fish.verdict ?? "none", ...(fish.corrected_length_mm === null ? [] : ["corrected"])];
}

function sorted(fish) {
  const key = COLUMNS[state.column].key;
  const sign = state.descending ? -1 : 1;
  const compare = (a, b) => (a < b ? -1 : a > b ? 1 : 0);
  return [...fish].sort((a, b) => sign * compare(key(a), key(b)) || a.id - b.id);
}

function drawHead(onSort) {
  const head = document.getElementById("head");
  head.replaceChildren(...COLUMNS.map((column, k) => column.key === null ? element("span") : element("button", {
    type: "button",
    textContent: column.title + (k === state.column ? (state.descending ? " \u2193" : " \u2191") : ""),
    onclick: () => {
      state.descending = k === state.column && !state.descending;
      state.column = k;
      onSort();
      head.children[k].focus();
    },
  })));
}

// `isWhole`: also those out of sight, for paper.
function drawRows(onChoose, isWhole = false) {
  const table = document.getElementById("table");
  const rows = document.getElementById("rows");
  rows.style.height = `${state.shown.length * ROW_PX}px`;
  const first = isWhole ? 0 : Math.max(0, Math.floor(table.scrollTop / ROW_PX) - 3);
  const last = isWhole ? state.shown.length : Math.min(state.shown.length, Math.ceil((table.scrollTop + table.clientHeight) / ROW_PX) + 3);
  rows.replaceChildren(...state.shown.slice(first, last).map((fish, k) => {
    const row = rowOf(fish);
    row.style.top = `${(first + k) * ROW_PX}px`;
    row.onclick = () => onChoose(fish.id);
    return row;
  }));
}

function rowOf(fish) {
  const reasons = Object.entries(fish.refused).map(([reason, count]) => `${count} ${reason}`).join(", ");
  const interval = intervalOf(fish)?.map((mm) => cm(mm)).join(" to ") ?? fish.status;
  const corrected = fish.corrected_length_mm === null ? [] : [element("small", { textContent: `measured ${cm(fish.length_mm)} cm` })];
  const because = fish.verdict_reason ?? (fish.duplicate_of === null ? "" : `${fish.verdict === "merge" ? "into" : "of"} ${fish.duplicate_of}`);
  const species = fish.species === DATA.template ? "" : fish.species;
  const said = [because, species, fish.fate ?? ""].filter(Boolean).map((textContent) => element("small", { textContent }));
  const verdict = element("span", { textContent: VERDICTS[fish.verdict] ?? "", title: [because, species, fish.fate].filter(Boolean).join(", ") }, ...said);
  if (fish.verdict) verdict.className = fish.verdict === "accept" ? "good" : "bad";
  fish.image ??= isReview() ? thumbnailOfServer(fish) : fish.thumbnail ? element("img", { src: fish.thumbnail, alt: "", loading: "lazy" }) : element("span");
  const size = fish.is_legal_size === false ? element("small", { className: "bad", textContent: "below legal size" }) : "";
  return element(
    "div",
    { className: fish.id === state.chosen ? "row chosen" : "row", role: "row", "data-id": fish.id },
    fish.image,
    element("span", {}, element("b", { textContent: fish.track_id }), element("small", { textContent: fish.video, title: fish.video }), element("small", { textContent: fish.haul && `haul ${fish.haul}` })),
    element("span", {}, element("b", { textContent: lengthText(fish) }), ...corrected, element("small", { textContent: interval }), size),
    element("span", { textContent: `${fish.frames_used} of ${fish.frames_seen}` }),
    element("small", { textContent: reasons, title: reasons }),
    element("small", { className: "bad", textContent: fish.flags.join(", "), title: fish.flags.join(", ") }),
    verdict,
  );
}
