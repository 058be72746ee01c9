"""Draw messages as Rerun entities."""

import zlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from jaxtyping import Float

from stream_dmr.camera import Camera
from stream_dmr.localization.two_views import second_from_first
from stream_dmr.messages import (
    FishCrop,
    FishMessage,
    FittedMesh,
    FittedShape,
    Frame,
    LearntShapes,
    LengthEstimate,
    LocalizedFish,
    Message,
    Position,
    TrackEnded,
)
from stream_dmr.recording import topics
from stream_dmr.recording.codec import color_labels, compress
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.record import Record
from stream_dmr.recording.rerun.blueprint import (
    NOMINAL_DEPTH,
    PICTURES,
    appearance,
    log_camera,
    log_plane,
    middle_mm,
)
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.recording.view_geometry import (
    PALETTE,
    VIEW_QUALITY,
    FrameThrottle,
    PendingItems,
    color,
    fill_outlines,
    outlines,
    place_fit,
    shades,
    shrink_by_halves,
    view_factor,
)

# Timestamps above this (the year 1973) count from the Unix epoch, others from a file's start.
_EPOCH_NS = 10**17

_Values = np.ndarray | Sequence[Any]
"""The instances of one component in one row."""


class ColumnBuffer:
    """Rows of components by entity, each at a frame index and a capture time."""

    def __init__(self, rec: rr.RecordingStream) -> None:
        self._rec = rec
        self._rows: dict[tuple[str, type], list[Mapping[str, _Values]]] = defaultdict(list)
        self._moments: dict[tuple[str, type], list[tuple[int, int]]] = defaultdict(list)

    def add(self, path: str, archetype: Any, moment: tuple[int, int], **values: _Values) -> None:
        """Add one row at `moment`, its frame index and capture time in ns.

        `archetype` is Rerun's class, `values` its components' instances: the same names in every
        row of an entity.
        """
        self._rows[path, archetype].append(values)
        self._moments[path, archetype].append(moment)

    def send(self) -> None:
        # Entities are cleared before something is drawn at the same moment.
        for key in sorted(self._rows, key=lambda key: key[1] is not rr.Clear):
            path, archetype = key
            rows = self._rows[key]
            of_each = (_column(archetype, name, [row[name] for row in rows]) for name in rows[0])
            columns = list(chain.from_iterable(of_each))
            self._rec.send_columns(path, indexes=_times(self._moments[key]), columns=columns)
        self._rows.clear()
        self._moments.clear()


def payload_columns(data: bytes) -> dict[str, np.ndarray]:
    """The bytes and their CRC-32, since an .rrd has no checksums."""
    crc32 = np.array([zlib.crc32(data)], np.uint32)
    return {"payload": np.frombuffer(data, np.uint8), "crc32": crc32}


def _column(archetype: Any, name: str, rows: Sequence[_Values]) -> rr.ComponentColumnList:
    lengths = [len(row) for row in rows]
    if isinstance(rows[0], np.ndarray):
        values = np.concatenate(rows)
        if archetype is rr.AnyValues:  # which would split arrays into numbers
            offsets = np.cumsum([0, *lengths], dtype=np.int32)
            return archetype.columns(**{name: pa.ListArray.from_arrays(offsets, values)})
    else:
        values = list(chain.from_iterable(rows))
    return archetype.columns(**{name: values}).partition(lengths)


def _times(moments: Sequence[tuple[int, int]]) -> list[rr.TimeColumn]:
    frames, timestamps = np.array(moments, np.int64).T
    if timestamps[0] > _EPOCH_NS:
        time = rr.TimeColumn("time", timestamp=timestamps.astype("datetime64[ns]"))
    else:
        time = rr.TimeColumn("time", duration=timestamps.astype("timedelta64[ns]"))
    return [rr.TimeColumn("frame", sequence=frames), time]


_HALF_PIXEL = 0.5  # Rerun's origin is the corner of the top-left pixel, ours its centre
_MAX_TRACK_POINTS = 2000
_TRACK_COLOR = (90, 170, 230)


class SceneDrawing:
    """Draws a run: pictures and meshes at most `view_rate_hz` times a second, plots every frame.

    Rows are kept until `send`. Of a second camera its pictures, masks and outlines are drawn.
    """

    def __init__(
        self,
        rec: rr.RecordingStream,
        header: RunHeader,
        settings: RecordingSettings,
        *,
        scene: str = "scene",
    ) -> None:
        """`scene`: the entity path in the place of "scene"."""
        self._rec, self._scene = rec, scene
        self._settings = settings
        self._faces = header.template.faces
        self._columns = ColumnBuffer(rec)
        self._throttle = FrameThrottle(settings.view_rate_hz)
        self._boxes = PendingItems[np.ndarray]()  # until their fish are localized
        self._shapes = PendingItems[FittedShape]()  # until their fish are localized
        self._reasons: dict[int, str] = {}  # why each track's last frame was not used
        self._tracks: set[int] = set()
        self.num_payloads: Counter[str] = Counter()  # by entity
        self._factor: int | None = None  # frame pixels per pixel of the view
        self._labels = np.zeros((0, 0), np.uint8)  # masks of one frame
        self._labels_frame = 0
        self._labelled: FishCrop | None = None  # the last crop in it; None: all are drawn
        self._no_masks = b""
        self._track: list[list[float]] = []  # latitude and longitude of positions so far
        self._track_every, self._num_positions = 1, 0
        rec.log(scene, rr.ViewCoordinates.RDF, static=True)
        for path, what in PICTURES.items():
            rec.log(self._path(path), what, static=True)
        self._second: SceneDrawing | None = None
        if header.second is not None:
            second = header.second.header
            self._second = SceneDrawing(rec, second, settings, scene=topics.SECOND_SCENE)
            if header.calibration is not None and second.calibration is not None:
                R, t = second_from_first(second.calibration, header.calibration)
                pose = rr.Transform3D(translation=t, mat3x3=R)
                rec.log(topics.SECOND_SCENE, pose, static=True)
        if header.calibration is not None:
            if scene == "scene":  # both cameras have the same plane
                log_plane(rec, header.calibration)
            self._set_camera(header.calibration.camera, depth=middle_mm(header.calibration)[2])

    def draw(self, record: Record) -> None:
        """Draw one message, with the parts of it that are not recorded."""
        if record.is_second:
            is_drawn = isinstance(record.whole, Frame | FishCrop) and record.whole.frame_index > 0
            if self._second is not None and is_drawn:
                self._second.draw(replace(record, is_second=False))
            return
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
            case Position() as position:
                self._position(position)
            case LearntShapes() | TrackEnded():  # the fish show the first, lengths the second
                pass

    def add_payload(self, record: Record) -> None:
        """Add the encoded message to the stream, numbered, since Rerun sorts by time."""
        path = record.topic.payload
        number = np.array([self.num_payloads[path]], np.uint64)
        self.num_payloads[path] += 1
        columns = payload_columns(record.payload)
        self._add(path, rr.AnyValues, record.message, number=number, **columns)

    def send(self) -> None:
        self._draw_masks()
        self._columns.send()
        if self._second is not None:
            self._second.send()

    def finish(self) -> None:
        """Draw the vessel's track, which is complete only at the end."""
        if len(self._track) > 1:
            track = rr.GeoLineStrings(lat_lon=[self._track], colors=[_TRACK_COLOR])
            self._rec.log(topics.TRACK, track, static=True)
        self.send()

    def _position(self, position: Position) -> None:
        place = [position.latitude, position.longitude]
        self._add(topics.VESSEL, rr.GeoPoints, position, positions=[place])
        if self._num_positions % self._track_every == 0:
            self._track.append(place)
        self._num_positions += 1
        if len(self._track) > _MAX_TRACK_POINTS:
            self._track = self._track[::2]
            self._track_every *= 2

    def _set_camera(self, camera: Camera, *, depth: float) -> None:
        self._factor = view_factor(camera.width, camera.height, most_px=self._settings.view_px)
        place = self._path(topics.CAMERA)
        log_camera(self._rec, camera, place, depth=depth, factor=self._factor)
        size = (camera.height // self._factor, camera.width // self._factor)
        self._labels = np.zeros(size, np.uint8)
        self._no_masks = color_labels(self._labels, PALETTE)

    def _frame(self, frame: Frame) -> None:
        if not self._throttle.shows(frame):
            return
        # A frame comes before its fish, so the fish of the frame before are cleared here.
        for root in topics.FISH_ROOTS:
            self._add(root, rr.Clear, frame, is_recursive=[True])
        if self._labels.size:
            self._add(topics.MASKS, rr.EncodedImage, frame, blob=[self._no_masks])
        if frame.image.size:
            picture = shrink_by_halves(frame.image, most_px=self._settings.view_px)
            jpeg = compress(picture, format="jpeg", jpeg_quality=VIEW_QUALITY)
            self._add(topics.FRAME, rr.EncodedImage, frame, blob=[jpeg.data])

    def _crop(self, crop: FishCrop) -> None:
        if self._factor is None:
            self._set_camera(crop.frame_camera, depth=NOMINAL_DEPTH)
        if crop.track_id not in self._tracks:  # colours and names, once and static
            self._tracks.add(crop.track_id)
            for path, what in appearance(crop.track_id, self._faces).items():
                self._rec.log(self._path(path).format(id=crop.track_id), what, static=True)
        if not self._throttle.has_shown(crop.frame_index):
            return
        self._boxes.put(crop, crop.bbox_xyxy_px)
        strips = [self._in_view(line) for line in outlines(crop)]
        self._add(topics.OUTLINE, rr.LineStrips2D, crop, strips=strips)
        self._mask(strips, crop)

    def _mask(self, strips: Sequence[Float[np.ndarray, "_ 2"]], crop: FishCrop) -> None:
        """Add a mask to the masks of its frame, which are drawn together."""
        if self._labelled is not None and self._labelled.frame_index != crop.frame_index:
            self._draw_masks()
        if self._labelled is None and self._labels_frame != crop.frame_index:
            self._labels = np.zeros_like(self._labels)
        self._labels_frame, self._labelled = crop.frame_index, crop
        fill_outlines(self._labels, strips, label=crop.track_id % len(PALETTE) + 1)

    def _draw_masks(self) -> None:
        """Draw the masks of a frame so far; it replaces the picture of the same moment."""
        if self._labelled is not None:
            picture = color_labels(self._labels, PALETTE)
            self._add(topics.MASKS, rr.EncodedImage, self._labelled, blob=[picture])
            self._labelled = None

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
        if not self._throttle.has_shown(fish.frame_index):
            return
        if box is not None:
            self._box(box, fish)
        if fish.keypoints_px is not None:
            points = self._in_view(fish.keypoints_px)
            self._add(topics.KEYPOINTS_2D, rr.Points2D, fish, positions=points)
        if shape is not None:
            self._body(shape, fish)

    def _box(self, bbox_xyxy_px: Float[np.ndarray, "4"], fish: LocalizedFish) -> None:
        """Draw the box, labelled with the frame's length or reason."""
        low, high = self._in_view(bbox_xyxy_px.reshape(2, 2) - _HALF_PIXEL)
        labels = [f"fish {fish.track_id}: {_frame_result(fish)}"]
        parts = {"centers": (low + high)[None] / 2, "half_sizes": (high - low)[None] / 2}
        self._add(topics.BOX, rr.Boxes2D, fish, **parts, labels=labels)

    def _body(self, shape: FittedShape, fish: LocalizedFish) -> None:
        vertices, keypoints, midline = place_fit(shape, fish)
        if vertices is not None:
            vertices = vertices.astype(np.float32)
            parts = {"vertex_positions": vertices, "vertex_colors": shades(vertices, self._faces)}
            self._add(topics.MESH, rr.Mesh3D, fish, **parts)
        self._add(topics.KEYPOINTS_3D, rr.Points3D, fish, positions=keypoints)
        self._add(topics.MIDLINE, rr.LineStrips3D, fish, strips=[midline])

    def _length(self, estimate: LengthEstimate) -> None:
        track_id, reason = estimate.track_id, estimate.frame_reason
        if estimate.is_final:
            self._event(topics.RESULTS, estimate, _fish_result(estimate), rr.TextLogLevel.INFO)
        elif reason and reason != self._reasons.get(track_id):
            text = f"not used from here on: {reason}"
            self._event(topics.REFUSALS, estimate, text, rr.TextLogLevel.WARN)
        self._reasons[track_id] = reason
        if estimate.length_mm is not None and estimate.ci95_mm is not None:
            values = [estimate.length_mm, *estimate.ci95_mm]
            self._add(topics.LENGTH, rr.Scalars, estimate, scalars=values)

    def _event(
        self, path: str, estimate: LengthEstimate, text: str, level: rr.TextLogLevel
    ) -> None:
        line = f"fish {estimate.track_id}: {text}"
        tint = [color(estimate.track_id)]
        self._add(path, rr.TextLog, estimate, text=[line], level=[str(level)], color=tint)

    def _add(self, path: str, archetype: Any, message: Message, **values: Any) -> None:
        path = self._path(path)
        if isinstance(message, FishMessage):
            path = path.format(id=message.track_id)
        moment = (message.frame_index, message.timestamp_ns)
        self._columns.add(path, archetype, moment, **values)

    def _path(self, path: str) -> str:
        return path.replace("scene/", f"{self._scene}/", 1)

    def _in_view(self, pixels: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Frame pixels as Rerun's pixels of the shown picture."""
        return (pixels + _HALF_PIXEL) / (self._factor or 1)


def _frame_result(fish: LocalizedFish) -> str:
    if not fish.accepted:
        return fish.reason
    return "fitted" if fish.length_mm is None else f"{fish.length_mm:.0f} mm"


def _fish_result(estimate: LengthEstimate) -> str:
    frames = f"{estimate.frames_used} of {estimate.frames_seen} frames used"
    if estimate.length_mm is None:
        return f"no length ({estimate.status}), {frames}"
    ci95_mm = estimate.ci95_mm
    interval = "" if ci95_mm is None else f" (95 %: {ci95_mm[0]:.1f} to {ci95_mm[1]:.1f})"
    return f"{estimate.length_mm:.1f} mm{interval}, {frames}"
