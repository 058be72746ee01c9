"""Draws messages into a Rerun stream: entity paths are those of topics.py."""

import cv2
import numpy as np
import rerun as rr
from jaxtyping import Float, Int

from stream_dmr.camera import frame_from_crop
from stream_dmr.geometry import arc_length
from stream_dmr.messages import (
    FishCrop,
    FittedMesh,
    FittedShape,
    Frame,
    LengthEstimate,
    LocalizedFish,
)
from stream_dmr.recording import topics
from stream_dmr.recording.header import Record, RunHeader
from stream_dmr.recording.rerun_view import NOMINAL_DEPTH, color, log_calibration, log_camera

_HALF_PIXEL = 0.5  # Rerun counts pixels from the corner of the top-left one, we from its centre
_THIN = rr.Radius.ui_points(1.2)
_DOTS = rr.Radius.ui_points([5.5, 3.5, 3.5])  # head, center, tail: the large one is the head
_WHITE = (255, 255, 255)
_SEE_THROUGH = 150  # opacity of a mesh, of 255: the midline shows


class Drawing:
    """What has been drawn so far of each fish. The stream's time is set by the caller."""

    def __init__(self, rec: rr.RecordingStream, header: RunHeader) -> None:
        self._rec = rec
        self._faces = header.template.faces
        self._shapes: dict[int, FittedShape] = {}  # of each track, until it is placed
        self._reasons: dict[int, str] = {}  # why each track's last frame was not used
        self._tracks: set[int] = set()
        self._has_camera = header.calibration is not None
        rec.log("scene", rr.ViewCoordinates.RDF, static=True)
        if header.calibration is not None:
            log_calibration(rec, header.calibration)

    def draw(self, record: Record) -> None:
        """Draw one message."""
        match record.message:
            case Frame():
                self._frame(record)
            case FishCrop() as crop:
                self._crop(crop)
            case FittedMesh() as fit:
                self._fit(fit)
            case LocalizedFish() as fish:
                self._localized(fish)
            case LengthEstimate() as estimate:
                self._length(estimate)

    def _frame(self, record: Record) -> None:
        # Comes before the fish of its frame, so it may wipe the fish of the frame before.
        for root in topics.FISH_ROOTS:
            self._rec.log(root, rr.Clear(recursive=True))
        if record.picture is not None:
            picture = rr.EncodedImage(contents=record.picture.data, media_type="image/jpeg")
            self._rec.log(topics.FRAME, picture)

    def _crop(self, crop: FishCrop) -> None:
        self._introduce(crop.track_id)
        if not self._has_camera:
            self._has_camera = True
            log_camera(self._rec, crop.frame_camera, depth=NOMINAL_DEPTH)
        box = rr.Boxes2D(
            array=crop.bbox_xyxy_px,
            array_format=rr.Box2DFormat.XYXY,
            colors=[color(crop.track_id)],
            labels=[f"fish {crop.track_id}"],
            radii=_THIN,
        )
        self._log(topics.BOX, crop.track_id, box)
        outline = rr.LineStrips2D(_outlines(crop), colors=[color(crop.track_id)], radii=_THIN)
        self._log(topics.OUTLINE, crop.track_id, outline)

    def _fit(self, fit: FittedMesh) -> None:
        if fit.shape is not None:
            self._shapes[fit.track_id] = fit.shape
            self._log(topics.IOU, fit.track_id, rr.Scalars(fit.shape.iou))

    def _localized(self, fish: LocalizedFish) -> None:
        track_id, tint = fish.track_id, [color(fish.track_id)]
        shape = self._shapes.pop(track_id, None)
        if fish.keypoints_px is not None:
            points = rr.Points2D(fish.keypoints_px + _HALF_PIXEL, colors=tint, radii=_DOTS)
            self._log(topics.KEYPOINTS_2D, track_id, points)
        if shape is not None:
            vertices, keypoints, midline = place(shape, fish)
            mesh = rr.Mesh3D.from_fields(
                vertex_positions=vertices, vertex_normals=_normals(vertices, self._faces)
            )
            self._log(topics.MESH, track_id, mesh)
            dots = rr.Points3D(keypoints, colors=[_WHITE], radii=_DOTS)
            self._log(topics.KEYPOINTS_3D, track_id, dots)
            line = rr.LineStrips3D([midline], colors=[_WHITE], radii=_THIN)
            self._log(topics.MIDLINE, track_id, line)
        if fish.bending_ratio is not None:
            self._log(topics.BENDING, track_id, rr.Scalars(fish.bending_ratio))
        if fish.accepted and fish.length_mm is not None:
            self._log(topics.FRAME_LENGTH, track_id, rr.Scalars(fish.length_mm))

    def _length(self, estimate: LengthEstimate) -> None:
        track_id, reason = estimate.track_id, estimate.frame_reason
        if estimate.is_final:
            self._event(topics.RESULTS, track_id, _verdict(estimate), rr.TextLogLevel.INFO)
        elif reason and reason != self._reasons.get(track_id):
            text = f"not used from here on: {reason}"
            self._event(topics.REFUSALS, track_id, text, rr.TextLogLevel.WARN)
        self._reasons[track_id] = reason
        if estimate.length_mm is not None and estimate.ci95_mm is not None:
            values = [estimate.length_mm, *estimate.ci95_mm]
            self._log(topics.LENGTH, track_id, rr.Scalars(values))

    def _introduce(self, track_id: int) -> None:
        """What never changes of a fish: once, for all time."""
        if track_id in self._tracks:
            return
        self._tracks.add(track_id)
        tint, name = color(track_id), f"fish {track_id}"
        mesh = rr.Mesh3D.from_fields(
            triangle_indices=self._faces, albedo_factor=(*tint, _SEE_THROUGH)
        )
        self._log(topics.MESH, track_id, mesh, static=True)
        lines = rr.SeriesLines(
            names=[name, f"{name} low", f"{name} high"],
            colors=[tint, (*tint, 110), (*tint, 110)],
            widths=[2.5, 1.0, 1.0],
        )
        self._log(topics.LENGTH, track_id, lines, static=True)
        dots = rr.SeriesPoints(names=f"{name}, frame", colors=tint, marker_sizes=2.0)
        self._log(topics.FRAME_LENGTH, track_id, dots, static=True)
        for path in (topics.IOU, topics.BENDING):
            self._log(path, track_id, rr.SeriesLines(names=name, colors=tint), static=True)

    def _event(self, path: str, track_id: int, text: str, level: rr.TextLogLevel) -> None:
        line = f"fish {track_id}: {text}"
        self._rec.log(path, rr.TextLog(line, level=str(level), color=color(track_id)))

    def _log(
        self, path: str, track_id: int, what: rr.AsComponents, *, static: bool = False
    ) -> None:
        self._rec.log(path.format(id=track_id), what, static=static)


def place(
    shape: FittedShape, fish: LocalizedFish
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "3 3"], Float[np.ndarray, "M 3"]]:
    """Vertices, keypoints and midline of a fit where its fish hangs, in mm in the camera frame.

    Both are in the orientation of the camera, so a scale and a shift do it: the ratio of the
    midlines' arcs, and center keypoint to center keypoint. Without millimetres the shape is scaled
    about the camera to a body length of 1, which leaves its picture as it is.
    """
    arc = arc_length(shape.midline)
    if fish.keypoints_mm is None or fish.midline_mm is None:
        return shape.vertices / arc, shape.keypoints / arc, shape.midline / arc
    scale = arc_length(fish.midline_mm) / arc
    vertices = (shape.vertices - shape.keypoints[1]) * scale + fish.keypoints_mm[1]
    return vertices, fish.keypoints_mm, fish.midline_mm


def _outlines(crop: FishCrop) -> list[Float[np.ndarray, "N 2"]]:
    """Closed outlines of the mask, in Rerun's frame pixels."""
    contours, _ = cv2.findContours(
        crop.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    cameras = {"crop_camera": crop.crop_camera, "frame_camera": crop.frame_camera}
    closed = [np.concatenate([contour, contour[:1]])[:, 0] for contour in contours]
    return [frame_from_crop(line.astype(float), **cameras) + _HALF_PIXEL for line in closed]


def _normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Area-weighted vertex normals, for smooth shading only."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    weighted = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    corners = faces.ravel()
    sums = [np.bincount(corners, weighted[:, axis], len(vertices)) for axis in range(3)]
    normals = np.stack(sums, axis=1)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _verdict(estimate: LengthEstimate) -> str:
    frames = f"{estimate.frames_used} of {estimate.frames_seen} frames used"
    if estimate.length_mm is None:
        return f"no length ({estimate.status}), {frames}"
    return f"{estimate.length_mm:.1f} ± {estimate.length_std_mm or 0:.1f} mm, {frames}"
