"""Geometry, colours and frame rate of the views."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Generic, TypeVar

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.spatial import KDTree

from stream_dmr.camera import frame_from_crop
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.fitting.shape.space import reshaped
from stream_dmr.fitting.solver.spine import KINDS, deform
from stream_dmr.geometry import arc_length, points_along
from stream_dmr.messages import FishCrop, FittedMesh, FittedShape, Frame, LocalizedFish
from stream_dmr.recording.reading import Recording, known_shapes
from stream_dmr.template.template import Template

T = TypeVar("T")

# Frames, or fish in a frame, that later stages may still report on: the chain's queues hold fewer.
MAX_PENDING = 64
VIEW_QUALITY = 70  # of the pictures, as JPEG: they are only for orientation


class FrameThrottle:
    """Selects the frames that are shown: the first of each 1 / `rate_hz` of capture time."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._slot = -1
        self._shown: deque[int] = deque(maxlen=MAX_PENDING)

    def shows(self, frame: Frame) -> bool:
        """Decide about the next frame, and remember the decision."""
        slot = int(frame.timestamp_ns * self._rate_hz // 1e9)
        if slot == self._slot:
            return False
        self._slot = slot
        self._shown.append(frame.frame_index)
        return True

    def has_shown(self, frame_index: int) -> bool:
        return frame_index in self._shown


class PendingItems(Generic[T]):
    """Items of one stage, kept per fish and frame until a later stage takes them."""

    def __init__(self) -> None:
        self._items: dict[tuple[int, int], T] = {}

    def put(self, fish: FishCrop | FittedMesh, item: T) -> None:
        """Keep `item`; beyond `MAX_PENDING` the oldest item is dropped."""
        self._items[fish.track_id, fish.frame_index] = item
        if len(self._items) > MAX_PENDING:  # a live view misses messages
            del self._items[next(iter(self._items))]

    def take(self, fish: LocalizedFish) -> T | None:
        return self._items.pop((fish.track_id, fish.frame_index), None)


class MeshRebuilder:
    """Deforms the template of a recording, or its candidate shapes, by recorded parameters."""

    @classmethod
    def of(cls, recording: Recording) -> "MeshRebuilder":
        return cls(recording.header.template, known_shapes(recording))

    def __init__(self, template: Template, candidates: CandidateShapes | None) -> None:
        shapes = [reshaped(template, c.coefficients) for c in candidates or ()]
        self._bodies = [Body.from_template(shape) for shape in shapes or [template]]

    def with_vertices(self, fit: FittedMesh) -> FittedMesh:
        """The fit, with computed vertices if it lacks them: within 1e-12 of the originals."""
        shape, report = fit.shape, fit.report
        if shape is None or report is None or shape.vertices is not None:
            return fit
        body = self._bodies[shape.candidate or 0]
        points = deform(body, KINDS[report.deformation], shape.parameters)
        v = body.num_vertices
        # Head and center determine the fit's place along the viewing ray of its crop; the tail of
        # a still may have been moved on behind the mesh.
        offset = (shape.keypoints[:2] - points[v : v + 2]).mean(axis=0)
        return replace(fit, shape=replace(shape, vertices=points[:v] + offset))


# RGB after Okabe and Ito, "Color Universal Design" (2008): distinct also for the colour-blind.
# Black is left out and blue is brighter than theirs, since the views are dark.
PALETTE = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (204, 121, 167),
    (213, 94, 0),
    (122, 130, 255),
)


def color(track_id: int) -> tuple[int, int, int]:
    """The RGB colour of a track; it repeats after seven."""
    return PALETTE[track_id % len(PALETTE)]


# Chosen by eye. The unit vector points to the light: above, to the right of and behind the camera.
_LIGHT = np.array([0.3, -0.6, -0.742])
_AMBIENT = 0.25


def place_fit(
    shape: FittedShape, fish: LocalizedFish
) -> tuple[Float[np.ndarray, "V 3"] | None, Float[np.ndarray, "3 3"], Float[np.ndarray, "M 3"]]:
    """Vertices, keypoints and midline of a fit at its localized place, mm in the camera frame.

    Fit and camera frame have the same orientation, so a scale (the ratio of the midlines' arc
    lengths) and a shift (center keypoint to center keypoint) suffice. The mesh of a fish placed by
    two cameras is bent along their midline. Without millimetres the shape is scaled about the
    camera to a body length of 1, which leaves its projection unchanged. Vertices are None if the
    shape has none.
    """
    arc, vertices = arc_length(shape.midline), shape.vertices
    if fish.keypoints_mm is None or fish.midline_mm is None:
        placed = None if vertices is None else vertices / arc
        return placed, shape.keypoints / arc, shape.midline / arc
    scale = arc_length(fish.midline_mm) / arc
    if vertices is not None:
        vertices = (vertices - shape.keypoints[1]) * scale + fish.keypoints_mm[1]
        alone = (shape.midline - shape.keypoints[1]) * scale + fish.keypoints_mm[1]
        if not np.allclose(alone, fish.midline_mm):
            vertices = bend_along(vertices, alone, fish.midline_mm)
    return vertices, fish.keypoints_mm, fish.midline_mm


_STATIONS = 200  # of a midline; chosen: steps between them are not seen


def bend_along(
    vertices: Float[np.ndarray, "V 3"],
    midline: Float[np.ndarray, "M 3"],
    target: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "V 3"]:
    """Vertices around a midline, moved to another midline of about the same length.

    Each vertex moves with the nearest station of its midline, turned like the direction there.
    """
    (old, along), (new, target_along) = _stations(midline), _stations(target)
    nearest = KDTree(old).query(vertices)[1]
    offsets = vertices - old[nearest]
    # Rodrigues: the least turn of each direction into the other.
    axis = np.cross(along, target_along)[nearest]
    cosine = (along * target_along).sum(axis=1)[nearest, None]
    turned = np.cross(axis, offsets)
    turned += np.cross(axis, turned) / np.maximum(1 + cosine, 1e-9)
    return new[nearest] + offsets + turned


def _stations(
    midline: Float[np.ndarray, "M 3"],
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"]]:
    """Points at equal parts of a midline's length, and the directions there."""
    points = points_along(midline, np.linspace(0, 1, _STATIONS))
    along = np.gradient(points, axis=0)
    return points, along / np.linalg.norm(along, axis=1, keepdims=True)


def outlines(crop: FishCrop) -> list[Float[np.ndarray, "N 2"]]:
    """The outlines of the mask, each closed, in frame pixels."""
    contours, _ = cv2.findContours(
        crop.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    cameras = {"crop_camera": crop.crop_camera, "frame_camera": crop.frame_camera}
    closed = [np.concatenate([contour, contour[:1]])[:, 0] for contour in contours]
    return [frame_from_crop(line.astype(float), **cameras) for line in closed]


def fill_outlines(
    labels: UInt8[np.ndarray, "H W"], outlines: Sequence[Float[np.ndarray, "_ 2"]], *, label: int
) -> None:
    """Write `label` inside closed outlines, whose origin is the corner of the top-left pixel."""
    cv2.fillPoly(labels, [np.round(line - 0.5).astype(np.int32) for line in outlines], label)


def shades(
    vertices: Float32[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> UInt8[np.ndarray, "V 3"]:
    """Grey level of each vertex under a light above the camera: a third of the bytes of normals.

    A vertex's normal is the area-weighted mean of its faces' normals, the sum of cross products.
    """
    a, b, c = (vertices.T[:, corner] for corner in faces.T)
    u, v = b - a, c - a
    weighted = [u[k] * v[m] - u[m] * v[k] for k, m in ((1, 2), (2, 0), (0, 1))]
    corners = faces.ravel()
    sums = [np.bincount(corners, np.repeat(axis, 3), len(vertices)) for axis in weighted]
    normals = np.stack(sums, axis=1)
    lit = normals @ _LIGHT / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    grey = 255 * (_AMBIENT + (1 - _AMBIENT) * (0.5 + 0.5 * lit))
    return grey.astype(np.uint8)[:, None].repeat(3, axis=1)


def view_factor(width: int, height: int, *, most_px: int) -> int:
    """Frame pixels per pixel of the view: a power of two that divides both sides of the frame.

    The smallest with which no side is longer than `most_px`, or else the largest there is.
    """
    factor = 1
    while max(width, height) > most_px * factor and not (width | height) // factor % 2:
        factor *= 2
    return factor


def shrink_by_halves(
    image: UInt8[np.ndarray, "H W 3"], *, most_px: int
) -> UInt8[np.ndarray, "h w 3"]:
    """The image at 1 / `view_factor` of its size, halved repeatedly, which is fast."""
    height, width = image.shape[:2]
    for _ in range(view_factor(width, height, most_px=most_px).bit_length() - 1):
        height, width = height // 2, width // 2
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return image
