// The clip around a fish: its frames, played at their own speed, with the outlines of all fish.

const CLIP_CANVAS = element("canvas", { id: "clip", width: 16, height: 9, tabIndex: 0, "aria-label": "Clip around the fish" });
const CLIP_SLIDER = element("input", { id: "clip-at", type: "range", min: 0, max: 0, value: 0, "aria-label": "Frame of the clip" });
const CLIP_TEXT = element("output", { id: "clip-text" });
const CLIP_PLAY = element("button", { type: "button", id: "clip-play", onclick: () => togglePlay() });
const MAX_CLIPS = 4;  // kept, so that going back and on is quick
const CHOSEN_COLOUR = "#5ae65a", OTHER_COLOUR = "#ffffffb0", DRAWN_COLOUR = "#ff9d2e";

const player = { clip: null, fish: null, shift: 0, at: 0, isPlaying: true, isZoomed: true, hasOutlines: true, from: 0, box: null };
const clips = new Map();

function bindKey(name, key) {
  return [`${name} `, element("kbd", { textContent: key })];
}

function clipPane() {
  const button = (id, onclick, ...label) => element("button", { type: "button", id, onclick }, ...label);
  const named = (ariaLabel, sign) => Object.assign(sign, { ariaLabel });
  return element("div", { id: "clip-pane" }, CLIP_CANVAS,
    element("div", { className: "bar" }, CLIP_PLAY, named("Frame before", button("clip-back", () => stepFrame(-1), "\u2039")), CLIP_SLIDER, named("Next frame", button("clip-on", () => stepFrame(1), "\u203a"))),
    element("div", { className: "bar" },
      button("clip-zoom", toggleZoom, ...bindKey("Zoom", "z")), button("clip-outlines", toggleOutlines, ...bindKey("Outlines", "o")),
      button("clip-earlier", () => shiftClip(-1), ...bindKey("Earlier", "<")), button("clip-later", () => shiftClip(1), ...bindKey("Later", ">")), CLIP_TEXT));
}

// A clip of the server: {frames: [{frame, time_ns, size, fish, image}], isDone}. Frames come in as they are decoded.
function loadClip(fish, shift) {
  const key = [fish.id, shift, fish.origin, fish.frames_seen].join("/");
  if (clips.has(key)) return clips.get(key);
  const clip = { frames: [], isDone: false, error: "", stop: new AbortController() };
  clips.set(key, clip);
  // One clip is read at a time: two would take turns in searching the same video.
  for (const [old, one] of [...clips].filter(([, one], k) => one !== clip && (!one.isDone || k < clips.size - MAX_CLIPS))) {
    one.stop.abort();
    clips.delete(old);
  }
  readClip(clip, `clip?run=${fish.run}&fish=${fish.track_id}&shift=${shift}`).catch((error) => { if (error.name !== "AbortError") clip.error = "The clip can't be read: stream-dmr review has ended."; });
  return clip;
}

async function readClip(clip, address) {
  const answer = await fetch(address, { signal: clip.stop.signal });
  if (!answer.ok) throw new Error("no clip");
  const reader = answer.body.getReader();
  let waiting = new Uint8Array(0), isOpen = true, header = null;
  const chunk = async () => {
    const size = () => (waiting.length < 4 ? Infinity : 4 + new DataView(waiting.buffer, waiting.byteOffset).getUint32(0, true));
    while (isOpen && waiting.length < size()) {
      const { done, value } = await reader.read();
      isOpen = !done;
      if (value) { const more = new Uint8Array(waiting.length + value.length); more.set(waiting); more.set(value, waiting.length); waiting = more; }
    }
    if (waiting.length < size()) return null;
    const content = waiting.subarray(4, size());
    waiting = waiting.subarray(size());
    return content;
  };
  while ((header = await chunk()) !== null) {
    const frame = JSON.parse(new TextDecoder().decode(header));
    const jpeg = await chunk();
    frame.image = jpeg?.length ? await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" })) : null;
    clip.frames.push(frame);
    if (clip === player.clip) frameCame();
  }
  clip.isDone = true;
  if (clip === player.clip) clipCame();
}

function openClip(fish, shift = 0) {
  const isSame = player.fish?.id === fish.id && player.shift === shift && player.clip && player.fish.frames_seen === fish.frames_seen;
  Object.assign(player, { fish, shift });
  if (isSame) return drawClip();
  Object.assign(player, { clip: loadClip(fish, shift), at: 0, isPlaying: true, from: 0, box: null });
  player.clip.frames.length ? frameCame() : drawClip();
  if (player.clip.isDone) clipCame();
}

function shiftClip(by) {
  if (player.fish) openClip(player.fish, player.shift + by);
}

// The first frame is shown at once; the clip starts where the fish comes into view.
function frameCame() {
  const { frames } = player.clip;
  CLIP_SLIDER.max = frames.length - 1;
  for (const one of frames.slice(-1)) growBox(one);
  if (frames.length === 1) { player.from = performance.now(); drawClip(); requestAnimationFrame(playOn); }
}

function clipCame() {
  player.box = null;
  for (const one of player.clip.frames) growBox(one);
  drawClip();
  const next = nextUnreviewed(player.fish.id);
  if (!next) return;
  loadClip(next, 0);
  if (!next.detail) detailOfServer(next).then((detail) => { next.detail = detail; });
}

function growBox(frame) {
  for (const one of frame.fish) {
    if (one.fish !== player.fish.track_id) continue;
    for (const line of one.mask) for (let k = 0; k < line.length; k += 2) {
      const [x, y] = [line[k], line[k + 1]], b = player.box ?? [x, y, x, y];
      player.box = [Math.min(b[0], x), Math.min(b[1], y), Math.max(b[2], x), Math.max(b[3], y)];
    }
  }
}

function playOn(now) {
  const { clip } = player;
  if (!player.isPlaying || !clip?.frames.length) return;
  const time = (k) => Number(BigInt(clip.frames[k].time_ns) - BigInt(clip.frames[0].time_ns)) / 1e6;
  const played = now - player.from;
  let at = player.at;
  while (at + 1 < clip.frames.length && time(at + 1) <= played) at += 1;
  if (at + 1 >= clip.frames.length && clip.isDone && played > time(at) + 300) { at = 0; player.from = now; }
  if (at !== player.at) { player.at = at; drawClip(); }
  requestAnimationFrame(playOn);
}

function togglePlay() {
  if (!player.clip?.frames.length) return;
  player.isPlaying = !player.isPlaying;
  const passed = Number(BigInt(player.clip.frames[player.at].time_ns) - BigInt(player.clip.frames[0].time_ns)) / 1e6;
  player.from = performance.now() - passed;
  if (player.isPlaying) requestAnimationFrame(playOn);
  drawClip();
}

function showFrame(at) {
  if (!player.clip?.frames.length) return;
  player.isPlaying = false;
  player.at = Math.max(0, Math.min(player.clip.frames.length - 1, at));
  drawClip();
}

function stepFrame(by) { showFrame(player.at + by); }
function toggleZoom() { player.isZoomed = !player.isZoomed; drawClip(); }
function toggleOutlines() { player.hasOutlines = !player.hasOutlines; drawClip(); }
function currentFrame() { return player.clip?.frames[player.at] ?? null; }

// The part of the frame that is shown, x, y, width, height: all of it, or the fish with some room.
function shownPart([width, height]) {
  if (!player.isZoomed || player.box === null || isDrawing()) return [0, 0, width, height];
  const [x0, y0, x1, y1] = player.box, room = 1.5;
  const w = Math.min(width, Math.max((x1 - x0) * room, ((y1 - y0) * room * width) / height, width / 8)), h = (w * height) / width;
  const inside = (middle, size, whole) => Math.max(0, Math.min(whole - size, middle - size / 2));
  return [inside((x0 + x1) / 2, w, width), inside((y0 + y1) / 2, h, height), w, h];
}

function drawClip() {
  const frame = currentFrame(), { clip } = player, draw = CLIP_CANVAS.getContext("2d");
  CLIP_PLAY.replaceChildren(...bindKey(player.isPlaying ? "Pause" : "Play", "space"));
  if (!frame) {
    draw.clearRect(0, 0, CLIP_CANVAS.width, CLIP_CANVAS.height);
    CLIP_TEXT.textContent = clip?.error || (clip?.isDone ? "no frames there" : "reading the clip ...");
    return;
  }
  const [width, height] = frame.size, part = shownPart(frame.size), scale = CLIP_CANVAS.width / part[2];
  CLIP_CANVAS.style.setProperty("--aspect", width / height);
  const canvasWidth = Math.min(960, Math.round((CLIP_CANVAS.clientWidth || 480) * devicePixelRatio)), canvasHeight = Math.round((canvasWidth * height) / width);
  if (CLIP_CANVAS.width !== canvasWidth || CLIP_CANVAS.height !== canvasHeight) { Object.assign(CLIP_CANVAS, { width: canvasWidth, height: canvasHeight }); return drawClip(); }
  draw.setTransform(1, 0, 0, 1, 0, 0);
  draw.fillStyle = "#333";
  draw.fillRect(0, 0, CLIP_CANVAS.width, CLIP_CANVAS.height);
  draw.setTransform(scale, 0, 0, scale, -part[0] * scale, -part[1] * scale);
  if (frame.image) draw.drawImage(frame.image, 0, 0, width, height);
  draw.lineWidth = 2 / scale;
  if (player.hasOutlines) for (const one of frame.fish) drawOutline(draw, one, scale, one.fish === player.fish.track_id);
  drawBoxes(draw, frame, scale);
  CLIP_SLIDER.value = player.at;
  const mine = frame.fish.find((one) => one.fish === player.fish.track_id);
  const state = mine ? (mine.reason ? `not used: ${mine.reason}` : "used") : "fish not found";
  CLIP_TEXT.textContent = `frame ${frame.frame}, ${state}${frame.image ? "" : " (no picture: give --source)"}`;
}

function drawOutline(draw, one, scale, isChosen) {
  draw.strokeStyle = isChosen ? CHOSEN_COLOUR : OTHER_COLOUR;
  for (const line of one.mask) {
    draw.beginPath();
    for (let k = 0; k < line.length; k += 2) draw.lineTo(line[k] + 0.5, line[k + 1] + 0.5);
    draw.closePath();
    draw.stroke();
  }
  if (!isChosen && one.mask.length) {
    draw.fillStyle = OTHER_COLOUR;
    draw.font = `${14 / scale}px sans-serif`;
    draw.fillText(`fish ${one.fish}`, one.mask[0][0], one.mask[0][1] - 4 / scale);
  }
  if (isChosen) one.points.forEach(([x, y], k) => {
    draw.fillStyle = POINTS[k][1];
    draw.beginPath();
    draw.arc(x + 0.5, y + 0.5, 4 / scale, 0, 7);
    draw.fill();
  });
}

CLIP_SLIDER.oninput = () => showFrame(Number(CLIP_SLIDER.value));
addEventListener("resize", () => player.fish && drawClip());
const CLIP_PANE = clipPane();
