// A fish that was missed: boxes that are drawn on frames of the clip. Between two they move evenly.

const drawing = { isOn: false, boxes: new Map(), start: null };  // by frame: {frame_index, timestamp_ns, x0, y0, x1, y1}

function isDrawing() { return drawing.isOn; }

function startDrawing() {
  Object.assign(drawing, { isOn: true, boxes: new Map(), start: null });
  player.isPlaying = false;
  CLIP_CANVAS.classList.add("drawing");
  showDrawing();
  say("");
}

function stopDrawing() {
  drawing.isOn = false;
  CLIP_CANVAS.classList.remove("drawing");
  showDrawing();
}

function showDrawing() {
  const bar = document.getElementById("drawing");
  if (!bar) return;
  bar.hidden = !drawing.isOn;
  const count = drawing.boxes.size;
  document.getElementById("drawing-text").textContent = count === 0
    ? "Draw a box around the whole fish."
    : `${count} ${count === 1 ? "box" : "boxes"}. Go to another frame and draw it again; between two boxes the fish is measured in every frame.`;
  drawClip();
}

// The box of a frame: drawn, or between two that were.
function boxIn(frame) {
  const drawn = [...drawing.boxes.values()].sort((a, b) => a.frame_index - b.frame_index);
  const after = drawn.find((box) => box.frame_index >= frame.frame), before = drawn.findLast((box) => box.frame_index <= frame.frame);
  if (!after || !before) return null;
  const share = after === before ? 0 : (frame.frame - before.frame_index) / (after.frame_index - before.frame_index);
  return ["x0", "y0", "x1", "y1"].map((name) => before[name] + share * (after[name] - before[name]));
}

function drawBoxes(draw, frame, scale) {
  const box = drawing.isOn ? boxIn(frame) : null;
  if (!box) return;
  draw.strokeStyle = DRAWN_COLOUR;
  draw.setLineDash(drawing.boxes.has(frame.frame) ? [] : [6 / scale, 4 / scale]);
  draw.strokeRect(box[0], box[1], box[2] - box[0], box[3] - box[1]);
  draw.setLineDash([]);
}

// Pixels of the frame under the pointer.
function framePoint(event, frame) {
  const box = CLIP_CANVAS.getBoundingClientRect(), [width, height] = frame.size;
  const along = (at, size, whole) => Math.max(0, Math.min(whole, (at / size) * whole));
  return [along(event.clientX - box.left, box.width, width), along(event.clientY - box.top, box.height, height)];
}

CLIP_CANVAS.onpointerdown = (event) => {
  const frame = currentFrame();
  if (!frame) return;
  if (!drawing.isOn) return togglePlay();
  drawing.start = framePoint(event, frame);
  CLIP_CANVAS.setPointerCapture(event.pointerId);
};
CLIP_CANVAS.onpointermove = (event) => {
  const frame = currentFrame();
  if (!drawing.isOn || !drawing.start || !frame) return;
  const [[x0, y0], [x1, y1]] = [drawing.start, framePoint(event, frame)];
  drawing.boxes.set(frame.frame, { frame_index: frame.frame, timestamp_ns: frame.time_ns, x0: Math.min(x0, x1), y0: Math.min(y0, y1), x1: Math.max(x0, x1), y1: Math.max(y0, y1) });
  showDrawing();
};
CLIP_CANVAS.onpointerup = CLIP_CANVAS.onpointercancel = () => { drawing.start = null; };
