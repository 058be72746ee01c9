"""Topics that Foxglove Studio draws: picture, camera, plane, meshes and keypoints.

Lengths are in metres there, and in body lengths without a calibration.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.timestamp_pb2 import Timestamp
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Calibration
from stream_dmr.messages import FishCrop, FittedMesh, FittedShape, Frame, LocalizedFish, Position
from stream_dmr.recording.codec import compress
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.record import Record
from stream_dmr.recording.topics import FOXGLOVE_TOPICS, RecordingSettings
from stream_dmr.recording.view_geometry import (
    VIEW_QUALITY,
    FrameThrottle,
    PendingItems,
    color,
    outlines,
    place_fit,
    shrink_by_halves,
    view_factor,
)

_CAMERA, _PLANE = "camera", "plane"
_LIFETIME_NS = 2_000_000_000  # how long a fish is shown after its last message
_M_PER_MM = 1e-3
_OPACITY = 0.7  # so that the midline shows through the mesh
_SCHEMAS = {
    schema.DESCRIPTOR.full_name: schema
    for schema in (
        *(CompressedImage, CameraCalibration, FrameTransform),
        *(SceneUpdate, ImageAnnotations, LocationFix),
    )
}


class FoxgloveTopics:
    """Shows at most `view_rate_hz` frames per second, as the .rrd does."""

    def __init__(self, header: RunHeader, settings: RecordingSettings) -> None:
        self.topics = {topic: _SCHEMAS[schema] for topic, schema in FOXGLOVE_TOPICS.items()}
        self._faces = header.template.faces
        self._calibration = header.calibration
        self._most_px = settings.view_px
        self._factor = 1
        self._throttle = FrameThrottle(settings.view_rate_hz)
        self._shapes = PendingItems[FittedShape]()

    def draw(self, record: Record) -> Iterator[tuple[str, Any]]:
        message = record.whole
        if isinstance(message, Frame):
            if self._throttle.shows(message):
                yield from self._frame(message)
        elif isinstance(message, Position):
            place = LocationFix(timestamp=_time(max(0, message.timestamp_ns)), frame_id=_CAMERA)
            place.latitude, place.longitude = message.latitude, message.longitude
            yield "/foxglove/position", place
        elif not self._throttle.has_shown(message.frame_index):
            return
        elif isinstance(message, FishCrop):
            lines = [_points(self._in_view(line), message.track_id) for line in outlines(message)]
            yield "/foxglove/outlines", ImageAnnotations(points=_stamped(lines, message))
        elif isinstance(message, FittedMesh) and message.shape is not None:
            self._shapes.put(message, message.shape)
        elif isinstance(message, LocalizedFish):
            yield from self._fish(message)

    def _frame(self, frame: Frame) -> Iterator[tuple[str, Any]]:
        height, width = frame.image.shape[:2]
        self._factor = view_factor(width, height, most_px=self._most_px)
        now = _time(frame.timestamp_ns)
        if self._calibration is not None:
            yield "/foxglove/camera", self._camera(self._calibration, now)
            yield "/foxglove/plane", _plane(self._calibration, now)
        picture = shrink_by_halves(frame.image, most_px=self._most_px)
        jpeg = compress(picture, format="jpeg", jpeg_quality=VIEW_QUALITY).data
        shown = CompressedImage(timestamp=now, frame_id=_CAMERA, data=jpeg, format="jpeg")
        yield "/foxglove/picture", shown

    def _fish(self, fish: LocalizedFish) -> Iterator[tuple[str, Any]]:
        if fish.keypoints_px is not None:
            points = _points(self._in_view(fish.keypoints_px), fish.track_id)
            points.type, points.thickness = PointsAnnotation.POINTS, 6.0
            yield "/foxglove/keypoints", ImageAnnotations(points=_stamped([points], fish))
        shape = self._shapes.take(fish)
        if shape is not None:
            yield "/foxglove/fish", self._scene(shape, fish)

    def _scene(self, shape: FittedShape, fish: LocalizedFish) -> SceneUpdate:
        vertices, _, midline = place_fit(shape, fish)
        unit = 1.0 if fish.midline_mm is None else _M_PER_MM
        update = SceneUpdate()
        entity = update.entities.add(frame_id=_CAMERA, id=f"fish {fish.track_id}")
        entity.timestamp.FromNanoseconds(fish.timestamp_ns)
        entity.lifetime.FromNanoseconds(_LIFETIME_NS)
        line = entity.lines.add(thickness=2.0, scale_invariant=True)
        _add(line.points, unit * midline)
        line.color.r = line.color.g = line.color.b = line.color.a = 1.0
        if vertices is not None:
            mesh = entity.triangles.add()
            _add(mesh.points, unit * vertices)
            mesh.indices.extend(self._faces.ravel().tolist())
            _paint(mesh.color, fish.track_id, opacity=_OPACITY)
        return update

    def _camera(self, calibration: Calibration, now: Timestamp) -> CameraCalibration:
        camera, factor = calibration.camera, self._factor
        K = camera.K.copy()
        K[:2, 2] = (K[:2, 2] + 0.5) - 0.5 * factor  # pixel centres are integers on both sides
        K[:2] /= factor
        model = "rational_polynomial" if len(camera.distortion) > 5 else "plumb_bob"
        return CameraCalibration(
            timestamp=now,
            frame_id=_CAMERA,
            width=camera.width // factor,
            height=camera.height // factor,
            distortion_model="kannala_brandt" if camera.is_fisheye else model,  # OpenCV's fisheye
            D=camera.distortion.tolist(),
            K=K.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
        )

    def _in_view(self, pixels: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Frame pixels as pixels of the shown picture; pixel centres are integers in both."""
        return (pixels + 0.5) / self._factor - 0.5


def _plane(calibration: Calibration, now: Timestamp) -> FrameTransform:
    plane = calibration.plane
    transform = FrameTransform(timestamp=now, parent_frame_id=_CAMERA, child_frame_id=_PLANE)
    x, y, z = (_M_PER_MM * plane.translation_mm).tolist()
    transform.translation.x, transform.translation.y, transform.translation.z = x, y, z
    x, y, z, w = Rotation.from_matrix(plane.rotation).as_quat().tolist()
    transform.rotation.x, transform.rotation.y, transform.rotation.z = x, y, z
    transform.rotation.w = w
    return transform


def _points(pixels: Float[np.ndarray, "N 2"], track_id: int) -> PointsAnnotation:
    line = PointsAnnotation(type=PointsAnnotation.LINE_STRIP, thickness=2.0)
    for x, y in pixels.tolist():
        line.points.add(x=x, y=y)
    _paint(line.outline_color, track_id, opacity=1.0)
    return line


def _stamped(
    annotations: list[PointsAnnotation], fish: FishCrop | LocalizedFish
) -> list[PointsAnnotation]:
    for annotation in annotations:
        annotation.timestamp.FromNanoseconds(fish.timestamp_ns)
    return annotations


def _add(points: Any, coordinates: Float[np.ndarray, "N 3"]) -> None:
    for x, y, z in coordinates.tolist():
        points.add(x=x, y=y, z=z)


def _paint(target: Any, track_id: int, *, opacity: float) -> None:
    target.r, target.g, target.b = (part / 255 for part in color(track_id))
    target.a = opacity


def _time(timestamp_ns: int) -> Timestamp:
    now = Timestamp()
    now.FromNanoseconds(timestamp_ns)
    return now
