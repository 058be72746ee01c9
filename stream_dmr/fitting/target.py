"""One mask as a solver needs it, with the camera that sees it."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.fitting.compiled import compiled
from stream_dmr.messages import FishCrop

_SMOOTHING_PX = 1.5  # of the staircase that pixels make of an edge; short beside any fin
_SPACING_PX = 2.0


class Target(NamedTuple):
    """Plain arrays, which compiled code takes as they are."""

    K: Float[np.ndarray, "3 3"]
    anchor: Float[np.ndarray, "3"]  # where the root rests: depth 1, in the middle of the crop
    plane_normal: Float[np.ndarray, "3"]  # of the plane that fish hang in, camera frame
    mask: Float[np.ndarray, "S S"]
    distance: Float[np.ndarray, "S S"]  # to the mask's edge, px, negative inside
    mask_area: float  # px
    contour: Float[np.ndarray, "C 2"]  # points on the mask's edge, px
    contour_normals: Float[np.ndarray, "C 2"]  # outward
    contour_lengths: Float[np.ndarray, "C"]  # px of edge that each point stands for

    @classmethod
    def from_crop(cls, crop: FishCrop, *, plane_normal: Float[np.ndarray, "3"]) -> "Target":
        """Distance map, contour and camera of a crop with a mask."""
        return cls(
            np.ascontiguousarray(crop.crop_camera.K),
            crop.crop_camera.middle_ray(),
            plane_normal,
            crop.mask.astype(np.float64),
            signed_distance(crop.mask),
            float(crop.mask.sum()),
            *mask_contour(crop.mask),
        )


def signed_distance(mask: Bool[np.ndarray, "S S"]) -> Float[np.ndarray, "S S"]:
    """Distance in pixels to the mask's edge, negative inside: the map behind `boundary_loss`."""
    inside = mask.astype(np.uint8)
    out = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    into = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return _signed(out, into)


@compiled
def _signed(out, into):
    """Half a pixel less on either side: both count to centres, and the edge lies half way.

    OpenCV's square roots differ in their last bits with where in memory an array lies; but what it
    takes the roots of are whole numbers, so they can be had back.
    """
    signed = np.empty(out.shape)
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            if out[i, k] > 0.0:
                signed[i, k] = np.sqrt(np.rint(np.float64(out[i, k]) ** 2)) - 0.5
            else:
                signed[i, k] = 0.5 - np.sqrt(np.rint(np.float64(into[i, k]) ** 2))
    return signed


def mask_contour(
    mask: Bool[np.ndarray, "S S"],
) -> tuple[Float[np.ndarray, "C 2"], Float[np.ndarray, "C 2"], Float[np.ndarray, "C"]]:
    """Points along the edge of a mask in pixels, unit outward normals, and each one's length.

    The edge runs between the centres of the last pixels inside and the first ones outside, so the
    traced pixels are moved half a pixel outward. Edges along the picture's border are left out: the
    fish goes on beyond them.
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    parts = [_edge(c[:, 0].astype(np.float64)) for c in contours if len(c) >= 8]
    if not parts:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    points, normals, lengths = (np.concatenate(values) for values in zip(*parts, strict=True))
    last = np.array(mask.shape[::-1]) - 1
    inside = ((points > 0.6) & (points < last - 0.6)).all(axis=1)
    return points[inside], normals[inside], lengths[inside]


def _edge(
    traced: Float[np.ndarray, "N 2"],
) -> tuple[Float[np.ndarray, "C 2"], Float[np.ndarray, "C 2"], Float[np.ndarray, "C"]]:
    points = _smooth(traced)
    tangent = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    # OpenCV traces outer contours with the outside to the right of the way as seen with y down.
    normals = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    perimeter = float(steps.sum())
    count = max(int(perimeter / _SPACING_PX), 8)
    at = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
    chosen = np.searchsorted(at, np.arange(count) * perimeter / count).clip(0, len(points) - 1)
    edge = points[chosen] + 0.5 * normals[chosen]
    return edge, normals[chosen], np.full(count, perimeter / count)


def _smooth(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    """Gaussian smoothing around a closed curve."""
    reach = np.arange(-4, 5)
    kernel = np.exp(-0.5 * (reach / _SMOOTHING_PX) ** 2)
    around = np.concatenate([points[-4:], points, points[:4]])
    kernel /= kernel.sum()
    return np.stack([np.convolve(around[:, k], kernel, mode="valid") for k in (0, 1)], axis=1)
