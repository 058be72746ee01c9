"""Draws messages into a Rerun stream: entity paths are those of topics.py."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float

from stream_dmr.camera import Camera
from stream_dmr.messages import (
    FishCrop,
    FittedMesh,
    FittedShape,
    Frame,
    LengthEstimate,
    LocalizedFish,
    Message,
)
from stream_dmr.recording.messages import topics
from stream_dmr.recording.messages.header import RunHeader
from stream_dmr.recording.messages.pictures import compress, paint
from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.rerun.blueprint import (
    NOMINAL_DEPTH,
    PICTURES,
    appearance,
    log_camera,
    log_plane,
    middle_mm,
)
from stream_dmr.recording.rerun.columns import Columns, blob
from stream_dmr.recording.rerun.palette import PALETTE, color
from stream_dmr.recording.rerun.throttle import Pace, Waiting
from stream_dmr.recording.rerun.view_geometry import (
    fill,
    halved,
    outlines,
    place,
    shades,
    view_factor,
)
from stream_dmr.recording.settings import RecordingSettings

_HALF_PIXEL = 0.5  # Rerun counts pixels from the corner of the top-left one, we from its centre
_JPEG_QUALITY = 70


class Drawing:
    """Draws a run: pictures and meshes at most `view_rate_hz` a second, plots for every frame.

    Rows wait until `send`.
    """

    def __init__(
        self, rec: rr.RecordingStream, header: RunHeader, settings: RecordingSettings
    ) -> None:
        self._rec = rec
        self._settings = settings
        self._faces = header.template.faces
        self._columns = Columns(rec)
        self._pace = Pace(settings.view_rate_hz)
        self._boxes = Waiting[np.ndarray]()  # until it is known what the frame says of the fish
        self._shapes = Waiting[FittedShape]()  # until they are placed
        self._reasons: dict[int, str] = {}  # why each track's last frame was not used
        self._tracks: set[int] = set()
        self.kept: Counter[str] = Counter()  # messages so far, by entity
        self._factor: int | None = None  # frame pixels per pixel of the view
        self._labels = np.zeros((0, 0), np.uint8)  # of the masks of frame `_labels_of` so far
        self._labels_of = 0
        self._no_masks = b""
        rec.log("scene", rr.ViewCoordinates.RDF, static=True)
        for path, what in PICTURES.items():
            rec.log(path, what, static=True)
        if header.calibration is not None:
            log_plane(rec, header.calibration)
            self._set_camera(header.calibration.camera, depth=middle_mm(header.calibration)[2])

    def draw(self, record: Record) -> None:
        """Draw one message, what is not recorded of it included."""
        match record.whole:
            case Frame() as frame:
                self._frame(frame)
            case FishCrop() as crop:
                self._crop(crop)
            case FittedMesh() as fit:
                self._fit(fit)
            case LocalizedFish() as fish:
                self._localized(fish)
            case LengthEstimate() as estimate:
                self._length(estimate)

    def keep(self, record: Record) -> None:
        """Put the encoded message beside the drawing, numbered, since Rerun sorts by time."""
        path = record.topic.payload
        number = np.array([self.kept[path]], np.uint64)
        self.kept[path] += 1
        self._add(path, rr.AnyValues, record.message, number=number, **blob(record.payload))

    def send(self) -> None:
        """Hand what was drawn over to Rerun."""
        self._columns.send()

    def _set_camera(self, camera: Camera, *, depth: float) -> None:
        self._factor = view_factor(camera.width, camera.height, most=self._settings.view_px)
        log_camera(self._rec, camera, depth=depth, factor=self._factor)
        size = (camera.height // self._factor, camera.width // self._factor)
        self._labels = np.zeros(size, np.uint8)
        self._no_masks = paint(self._labels, PALETTE)

    def _frame(self, frame: Frame) -> None:
        if not self._pace.shows(frame):
            return
        # Comes before the fish of its frame, so it may wipe the fish of the frame before.
        for root in topics.FISH_ROOTS:
            self._add(root, rr.Clear, frame, is_recursive=[True])
        if self._labels.size:
            self._add(topics.MASKS, rr.EncodedImage, frame, blob=[self._no_masks])
        if frame.image.size:
            picture = halved(frame.image, most=self._settings.view_px)
            jpeg = compress(picture, format="jpeg", jpeg_quality=_JPEG_QUALITY)
            self._add(topics.FRAME, rr.EncodedImage, frame, blob=[jpeg.data])

    def _crop(self, crop: FishCrop) -> None:
        if self._factor is None:
            self._set_camera(crop.frame_camera, depth=NOMINAL_DEPTH)
        self._introduce(crop.track_id)
        if not self._pace.has_shown(crop.frame_index):
            return
        self._boxes.put(crop, crop.bbox_xyxy_px)
        strips = [self._in_view(line) for line in outlines(crop)]
        self._add(topics.OUTLINE, rr.LineStrips2D, crop, strips=strips)
        self._mask(strips, crop)

    def _mask(self, strips: Sequence[Float[np.ndarray, "_ 2"]], crop: FishCrop) -> None:
        """The masks of a frame so far: each replaces the one before it, of the same moment."""
        if crop.frame_index != self._labels_of:
            self._labels_of = crop.frame_index
            self._labels = np.zeros_like(self._labels)
        fill(self._labels, strips, label=crop.track_id % len(PALETTE) + 1)
        self._add(topics.MASKS, rr.EncodedImage, crop, blob=[paint(self._labels, PALETTE)])

    def _fit(self, fit: FittedMesh) -> None:
        if fit.shape is not None:
            self._shapes.put(fit, fit.shape)
            self._add(topics.IOU, rr.Scalars, fit, scalars=[fit.shape.iou])
        if fit.report is not None:
            self._add(topics.FIT_MS, rr.Scalars, fit, scalars=[1e-6 * fit.report.elapsed_ns])

    def _localized(self, fish: LocalizedFish) -> None:
        shape = self._shapes.take(fish)
        if fish.bending_ratio is not None:
            self._add(topics.BENDING, rr.Scalars, fish, scalars=[fish.bending_ratio])
        if fish.accepted and fish.length_mm is not None:
            self._add(topics.FRAME_LENGTH, rr.Scalars, fish, scalars=[fish.length_mm])
        box = self._boxes.take(fish)
        if not self._pace.has_shown(fish.frame_index):
            return
        if box is not None:
            self._box(box, fish)
        if fish.keypoints_px is not None:
            points = self._in_view(fish.keypoints_px)
            self._add(topics.KEYPOINTS_2D, rr.Points2D, fish, positions=points)
        if shape is not None:
            self._body(shape, fish)

    def _box(self, bbox_xyxy_px: Float[np.ndarray, "4"], fish: LocalizedFish) -> None:
        """The box, with what this frame says of the fish."""
        low, high = self._in_view(bbox_xyxy_px.reshape(2, 2) - _HALF_PIXEL)
        parts = {
            "centers": (low + high)[None] / 2,
            "half_sizes": (high - low)[None] / 2,
            "labels": [f"fish {fish.track_id}: {_finding(fish)}"],
        }
        self._add(topics.BOX, rr.Boxes2D, fish, **parts)

    def _body(self, shape: FittedShape, fish: LocalizedFish) -> None:
        vertices, keypoints, midline = place(shape, fish)
        if vertices is not None:
            vertices = vertices.astype(np.float32)
            parts = {"vertex_positions": vertices, "vertex_colors": shades(vertices, self._faces)}
            self._add(topics.MESH, rr.Mesh3D, fish, **parts)
        self._add(topics.KEYPOINTS_3D, rr.Points3D, fish, positions=keypoints)
        self._add(topics.MIDLINE, rr.LineStrips3D, fish, strips=[midline])

    def _length(self, estimate: LengthEstimate) -> None:
        track_id, reason = estimate.track_id, estimate.frame_reason
        if estimate.is_final:
            self._event(topics.RESULTS, estimate, _verdict(estimate), rr.TextLogLevel.INFO)
        elif reason and reason != self._reasons.get(track_id):
            text = f"not used from here on: {reason}"
            self._event(topics.REFUSALS, estimate, text, rr.TextLogLevel.WARN)
        self._reasons[track_id] = reason
        if estimate.length_mm is not None and estimate.ci95_mm is not None:
            values = [estimate.length_mm, *estimate.ci95_mm]
            self._add(topics.LENGTH, rr.Scalars, estimate, scalars=values)

    def _introduce(self, track_id: int) -> None:
        """What never changes of a fish: once, for all time."""
        if track_id in self._tracks:
            return
        self._tracks.add(track_id)
        for path, what in appearance(track_id, self._faces).items():
            self._rec.log(path.format(id=track_id), what, static=True)

    def _event(
        self, path: str, estimate: LengthEstimate, text: str, level: rr.TextLogLevel
    ) -> None:
        line = f"fish {estimate.track_id}: {text}"
        tint = [color(estimate.track_id)]
        self._add(path, rr.TextLog, estimate, text=[line], level=[str(level)], color=tint)

    def _add(self, path: str, archetype: Any, message: Message, **values: Any) -> None:
        if not isinstance(message, Frame):
            path = path.format(id=message.track_id)
        moment = (message.frame_index, message.timestamp_ns)
        self._columns.add(path, archetype, moment, **values)

    def _in_view(self, pixels: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Frame pixels as Rerun counts them in the picture of the view."""
        return (pixels + _HALF_PIXEL) / (self._factor or 1)


def _finding(fish: LocalizedFish) -> str:
    if not fish.accepted:
        return fish.reason
    return "fitted" if fish.length_mm is None else f"{fish.length_mm:.0f} mm"


def _verdict(estimate: LengthEstimate) -> str:
    frames = f"{estimate.frames_used} of {estimate.frames_seen} frames used"
    if estimate.length_mm is None:
        return f"no length ({estimate.status}), {frames}"
    return f"{estimate.length_mm:.1f} ± {estimate.length_std_mm or 0:.1f} mm, {frames}"
