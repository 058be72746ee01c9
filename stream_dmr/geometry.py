"""Polylines, affine maps, boxes and connected components."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int32, Real, UInt8


def arc_lengths(points: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "M"]:
    """Distance along a polyline from its first point to each of its points, in the points' unit."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def arc_length(points: Float[np.ndarray, "M D"]) -> float:
    return float(arc_lengths(points)[-1])


def points_along(
    line: Float[np.ndarray, "M D"], shares: Float[np.ndarray, "S"] | Sequence[float]
) -> Float[np.ndarray, "S D"]:
    """Points of a polyline at these shares of its length."""
    arc = arc_lengths(line)
    return np.column_stack([np.interp(shares, arc / arc[-1], axis) for axis in line.T])


def bending_ratio(midline: Float[np.ndarray, "M 3"]) -> float:
    """Arc over chord of a midline (eq. 13): 1 for a straight fish, larger for a bent fish.

    Raises ValueError if both ends coincide, since the ratio has no value then.
    """
    chord = float(np.linalg.norm(midline[-1] - midline[0]))
    if chord == 0.0:
        raise ValueError("expected a midline with two distinct ends, got a closed one")
    return arc_length(midline) / chord


def transformed(
    points: Float[np.ndarray, "*N 2"], affine: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "*N 2"]:
    """Points (x, y) mapped as `cv2.warpAffine` maps pixels."""
    return points @ affine[:, :2].T + affine[:, 2]


def long_axis(points: Real[np.ndarray, "N 2"]) -> Float[np.ndarray, "2"]:
    """Unit vector along the larger principal axis of points, of either sign."""
    return np.linalg.eigh(np.cov(points.T))[1][:, 1]


def components(
    mask: UInt8[np.ndarray, "H W"],
) -> tuple[int, Int32[np.ndarray, "H W"], Int32[np.ndarray, "N 5"]]:
    """Number with the background, 0; labels; x, y, width, height and area of each, px.

    The labels are those of `cv2.connectedComponentsWithStats`, whose default algorithm is made for
    several threads and slow on a single one.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask, 8, cv2.CV_32S, cv2.CCL_BBDT
    )
    return count, np.asarray(labels, np.int32), np.asarray(stats, np.int32)


def oriented_extent(
    shape: Bool[np.ndarray, "H W"] | UInt8[np.ndarray, "H W"],
) -> tuple[float, float]:
    """Width and length of the smallest rotated rectangle around a shape, px; zeros if empty.

    From pixel center to pixel center: with the pixels themselves each is 1 px more.
    """
    # The outlines have the same hull as all pixels, which are fifty times as many.
    outlines, _ = cv2.findContours(shape.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not outlines:
        return 0.0, 0.0
    sides = cv2.minAreaRect(np.concatenate(outlines))[1]
    return min(sides), max(sides)


def whole_pixels(bbox_xyxy_px: Float[np.ndarray, "4"]) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 of a box rounded to pixel edges, at least one pixel wide and high."""
    x0, y0, x1, y1 = np.round(bbox_xyxy_px).astype(int).tolist()
    return x0, y0, max(x1, x0 + 1), max(y1, y0 + 1)


def longer_side(box: Float[np.ndarray, "4"]) -> float:
    return float((box[2:] - box[:2]).max())


def fraction_inside(box: Float[np.ndarray, "4"], other: Float[np.ndarray, "4"]) -> float:
    """The fraction of the area of `box` that lies inside `other`, 0 to 1."""
    area, _, shared = _areas(box, other)
    return shared / max(area, 1e-9)


def box_iou(box: Float[np.ndarray, "4"], other: Float[np.ndarray, "4"]) -> float:
    area, other_area, shared = _areas(box, other)
    return shared / max(area + other_area - shared, 1e-9)


def _areas(
    box: Float[np.ndarray, "4"], other: Float[np.ndarray, "4"]
) -> tuple[float, float, float]:
    """The areas of both boxes and of what they share; plain numbers are ten times as fast here."""
    x0, y0, x1, y1 = box.tolist()
    u0, v0, u1, v1 = other.tolist()
    shared = max(min(x1, u1) - max(x0, u0), 0.0) * max(min(y1, v1) - max(y0, v0), 0.0)
    return (x1 - x0) * (y1 - y0), (u1 - u0) * (v1 - v0), shared


# Mean breadth over length of bodies that count as slender: eels and needlefish, not pike. Chosen.
_SLENDER = 0.1


def misfit(iou: float, area: float, axis: Float[np.ndarray, "M D"]) -> float:
    """1 - IoU of two outlines of a body of this area along this axis, as gates compare it.

    An outline that is half a pixel off misses 3 % of a body 30 pixels broad, but 15 % of one that
    is 6 pixels broad. Of a slender body it is therefore the share of one a tenth as broad as long.
    """
    return (1.0 - iou) * min(1.0, area / max(_SLENDER * arc_length(axis) ** 2, 1e-9))
