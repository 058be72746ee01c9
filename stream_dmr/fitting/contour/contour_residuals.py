"""Distances between a body's rim and the target's contour, as a linear least-squares problem.

L_iou grows by |d| / A and L_boundary by c d^2 / 2 per pixel of rim that stands a distance d off the
target, with A the mask's area and c the scale of `losses.boundary_loss`. Reweighted least squares
turn both into w d^2 / 2 with w = 1 / (A max(|d|, eps)) + c. The distance is measured both ways,
each with half the weight: from the model's rim by the target's distance map, and from the target's
contour to the nearest rim edge that faces the same way; so that neither a tail left out nor a fin
too many goes unseen.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.outline import boundary_loss
from stream_dmr.fitting.contour.visible_rim import RimSlopes, VisibleRim
from stream_dmr.fitting.target import Target

# Residuals under half a pixel, the mask's own staircase, have one weight.
_FLAT_PX = 0.5
# A contour point belongs to rim edges whose normals are within 73 degrees of its own: less than 90,
# so that the two sides of a narrow tail are kept apart. Chosen by trial, as the next one.
_MIN_NORMAL_COSINE = 0.3
# Nearer than this to its edge, the way to it has no direction but noise: the edge's normal serves.
_MIN_GAP_PX = 0.25


class Residuals(NamedTuple):
    """A linear least-squares problem: sum_n weights_n (values_n + rows_n x)^2 / 2."""

    rows: Float[np.ndarray, "N P"]
    values: Float[np.ndarray, "N"]
    weights: Float[np.ndarray, "N"]


@compiled
def contour_residuals(
    target: Target,
    pixels: Float[np.ndarray, "V 2"],
    visible: VisibleRim,
    moved: RimSlopes,
) -> Residuals:
    """Distances between rim and contour, both ways, with their slopes to what `moved` has."""
    count = len(visible.edges) + len(target.contour)
    residuals = Residuals(
        np.empty((count, moved.slopes.shape[2])), np.empty(count), np.zeros(count)
    )
    _rim_rows(target, pixels, visible, moved, residuals)
    _contour_rows(target, pixels, visible, moved, residuals)
    return residuals


@compiled
def _weight(length_px: float, residual_px: float, target: Target) -> float:
    """The w above of a piece of outline, halved since both ways are counted."""
    iou = 1.0 / (target.mask_area * max(abs(residual_px), _FLAT_PX))
    return 0.5 * length_px * (iou + boundary_loss(1.0, len(target.mask)))


@compiled
def _rim_rows(
    target: Target,
    pixels: Float[np.ndarray, "V 2"],
    visible: VisibleRim,
    moved: RimSlopes,
    out: Residuals,
) -> None:
    """The model's rim in the target's signed distance field, into the first E rows."""
    edges, lengths, row_of, slopes = visible.edges, visible.lengths, moved.row_of, moved.slopes
    rows, values, weights = out.rows, out.values, out.weights
    for r in range(len(edges)):
        a, b = edges[r, 0], edges[r, 1]
        x, y = (pixels[a, 0] + pixels[b, 0]) / 2, (pixels[a, 1] + pixels[b, 1]) / 2
        value, gx, gy = _look_up(target.distance, x, y)
        values[r] = value
        weights[r] = _weight(lengths[r], value, target)
        i, j = row_of[a], row_of[b]
        for p in range(rows.shape[1]):
            rows[r, p] = 0.5 * (
                gx * (slopes[i, 0, p] + slopes[j, 0, p]) + gy * (slopes[i, 1, p] + slopes[j, 1, p])
            )


@compiled
def _look_up(field: Float[np.ndarray, "S S"], x: float, y: float) -> tuple[float, float, float]:
    """Value and unit gradient of a distance field between pixels; it goes on outside."""
    size = len(field)
    cx, cy = min(max(x, 0.0), size - 1.001), min(max(y, 0.0), size - 1.001)
    k, i = int(cx), int(cy)
    fx, fy = cx - k, cy - i
    f00, f01, f10, f11 = field[i, k], field[i, k + 1], field[i + 1, k], field[i + 1, k + 1]
    value = (f00 * (1 - fx) + f01 * fx) * (1 - fy) + (f10 * (1 - fx) + f11 * fx) * fy
    gx = (f01 - f00) * (1 - fy) + (f11 - f10) * fy
    gy = (f10 - f00) * (1 - fx) + (f11 - f01) * fx
    out_x, out_y = x - cx, y - cy
    gx, gy = gx + out_x, gy + out_y
    length = np.sqrt(gx * gx + gy * gy)
    if length < 1e-9:
        return value, 0.0, 0.0
    return value + np.sqrt(out_x * out_x + out_y * out_y), gx / length, gy / length


@compiled
def _contour_rows(
    target: Target,
    pixels: Float[np.ndarray, "V 2"],
    visible: VisibleRim,
    moved: RimSlopes,
    out: Residuals,
) -> None:
    """The target's contour to the nearest rim edge that faces the same way, into the last C rows.

    Points without such an edge weigh nothing.
    """
    edges, normals, row_of, slopes = visible.edges, visible.normals, moved.row_of, moved.slopes
    rows, values, weights = out.rows, out.values, out.weights
    starts, ways, scales = _segments(pixels, edges)
    for c in range(len(target.contour)):
        row = len(edges) + c
        qx, qy = target.contour[c, 0], target.contour[c, 1]
        nx, ny = target.contour_normals[c, 0], target.contour_normals[c, 1]
        best, edge, place = np.inf, -1, 0.0
        for r in range(len(edges)):
            if normals[r, 0] * nx + normals[r, 1] * ny < _MIN_NORMAL_COSINE:
                continue
            dx, dy = ways[r, 0], ways[r, 1]
            t = ((qx - starts[r, 0]) * dx + (qy - starts[r, 1]) * dy) * scales[r]
            t = min(max(t, 0.0), 1.0)
            ex, ey = starts[r, 0] + t * dx - qx, starts[r, 1] + t * dy - qy
            if ex * ex + ey * ey < best:
                best, edge, place = ex * ex + ey * ey, r, t
        if edge < 0:
            rows[row] = 0.0
            values[row] = 0.0
            continue
        ex = starts[edge, 0] + place * ways[edge, 0] - qx
        ey = starts[edge, 1] + place * ways[edge, 1] - qy
        gap = np.sqrt(best)
        is_out = ex * normals[edge, 0] + ey * normals[edge, 1] >= 0
        if gap > _MIN_GAP_PX:
            ux, uy = ex / gap, ey / gap
        else:
            ux, uy = normals[edge, 0], normals[edge, 1]
            gap = ex * ux + ey * uy
            is_out = True
        if not is_out:
            ux, uy, gap = -ux, -uy, -gap
        values[row] = gap
        weights[row] = _weight(target.contour_lengths[c], gap, target)
        i, j = row_of[edges[edge, 0]], row_of[edges[edge, 1]]
        for p in range(rows.shape[1]):
            rows[row, p] = (1 - place) * (ux * slopes[i, 0, p] + uy * slopes[i, 1, p]) + place * (
                ux * slopes[j, 0, p] + uy * slopes[j, 1, p]
            )


@compiled
def _segments(
    pixels: Float[np.ndarray, "V 2"], edges: Int[np.ndarray, "E 2"]
) -> tuple[Float[np.ndarray, "E 2"], Float[np.ndarray, "E 2"], Float[np.ndarray, "E"]]:
    """Where each edge begins, where it leads, and one over its squared length."""
    starts, ways = np.empty((len(edges), 2)), np.empty((len(edges), 2))
    scales = np.empty(len(edges))
    for r in range(len(edges)):
        a, b = edges[r, 0], edges[r, 1]
        starts[r, 0], starts[r, 1] = pixels[a, 0], pixels[a, 1]
        ways[r, 0], ways[r, 1] = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        scales[r] = 1.0 / (ways[r, 0] ** 2 + ways[r, 1] ** 2)
    return starts, ways, scales
