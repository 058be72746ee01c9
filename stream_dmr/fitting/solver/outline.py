"""The model's outline in the picture, and how well it covers the mask: compiled loops.

The same formulas as `silhouette.py` and `losses.py`, which are the reference that the tests hold
them against.

Distances between a body's rim and the target's contour, as a linear least-squares problem.

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
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.solver.spine import jacobian
from stream_dmr.fitting.target import Target

COVERED = 0.5  # share of a pixel from which on it counts as the body's, or the mask's


class Rendering(NamedTuple):
    """A deformed body in its target's picture."""

    points: Float[np.ndarray, "N 3"]  # deformed, centered on the root
    pixels: Float[np.ndarray, "V 2"]  # of the vertices
    rim: Int[np.ndarray, "R 2"]  # vertices of the edges between faces seen from the front and back
    covered: Float[np.ndarray, "S S"]  # share of each pixel
    # Normals of faces, and offsets of vertices from their neighbours; empty without smoothness.
    normals: Float[np.ndarray, "F 3"]
    offsets: Float[np.ndarray, "V 3"]


@compiled
def project(
    points: Float[np.ndarray, "N 3"], anchor: Float[np.ndarray, "3"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "N 2"]:
    """Pixels of points that are centered on the root."""
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        depth = points[n, 2] + anchor[2]
        out[n, 0] = (points[n, 0] + anchor[0]) / depth * K[0, 0] + K[0, 2]
        out[n, 1] = (points[n, 1] + anchor[1]) / depth * K[1, 1] + K[1, 2]
    return out


@compiled
def rim_edges(pixels: Float[np.ndarray, "V 2"], body: Body) -> Int[np.ndarray, "R 2"]:
    """Edges between faces that look at the camera and faces that look away."""
    faces, edges, edge_faces = body.faces, body.edges, body.edge_faces
    is_front = np.empty(len(faces), np.bool_)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        abx, aby = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        acx, acy = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
        is_front[f] = abx * acy - aby * acx < 0
    rim = np.empty((len(edges), 2), np.int64)
    count = 0
    for e in range(len(edges)):
        along = is_front[edge_faces[e, 0]]
        if along != is_front[edge_faces[e, 1]]:
            rim[count, 0] = edges[e, 1] if along else edges[e, 0]
            rim[count, 1] = edges[e, 0] if along else edges[e, 1]
            count += 1
    return rim[:count]


@compiled
def coverage(
    pixels: Float[np.ndarray, "V 2"], rim: Int[np.ndarray, "R 2"], size: int
) -> Float[np.ndarray, "{size} {size}"]:
    """Covered share of each pixel: signed areas of the rim edges, summed along rows."""
    grid = np.zeros((size, size))
    for r in range(len(rim)):
        x0, y0 = pixels[rim[r, 0], 0] + 0.5, pixels[rim[r, 0], 1] + 0.5
        x1, y1 = pixels[rim[r, 1], 0] + 0.5, pixels[rim[r, 1], 1] + 0.5
        if y0 == y1:
            continue
        sign = 1.0 if y0 > y1 else -1.0
        if y0 > y1:
            x0, y0, x1, y1 = x1, y1, x0, y0
        slope = (x1 - x0) / (y1 - y0)
        top, bottom = max(y0, 0.0), min(y1, float(size))
        row = int(np.floor(top))
        while top < bottom:
            low = min(bottom, row + 1.0)
            _add_row(grid, row, x0 + (top - y0) * slope, x0 + (low - y0) * slope, low - top, sign)
            top = low
            row += 1
    whole = size // 4 * 4
    for i in range(0, whole, 4):  # four rows at a time: each sum waits for the addition before it
        a = b = c = d = 0.0
        for k in range(size):
            a, b = a + grid[i, k], b + grid[i + 1, k]
            c, d = c + grid[i + 2, k], d + grid[i + 3, k]
            grid[i, k], grid[i + 1, k] = min(max(a, 0.0), 1.0), min(max(b, 0.0), 1.0)
            grid[i + 2, k], grid[i + 3, k] = min(max(c, 0.0), 1.0), min(max(d, 0.0), 1.0)
    for i in range(whole, size):
        total = 0.0
        for k in range(size):
            total += grid[i, k]
            grid[i, k] = min(max(total, 0.0), 1.0)
    return grid


@compiled
def _add_row(
    grid: Float[np.ndarray, "S S"], row: int, xa: float, xb: float, height: float, sign: float
) -> None:
    """Add the signed area right of one piece of an edge within one row of pixels."""
    size = grid.shape[1]
    if xa > xb:
        xa, xb = xb, xa
    if xa >= size:
        return
    if xb <= 0.0:
        grid[row, 0] += sign * height
        return
    per_x = height / (xb - xa) if xb > xa else 0.0
    left = xa
    if xa < 0.0:
        grid[row, 0] += sign * per_x * -xa
        left = 0.0
    right = min(xb, float(size))
    column = int(np.floor(left))
    while column < size:
        end = min(right, column + 1.0)
        share = per_x * (end - left) if xb > xa else height
        own = share * (column + 1.0 - (left + end) / 2)
        grid[row, column] += sign * own
        if column + 1 < size:
            grid[row, column + 1] += sign * (share - own)
        if end >= right:
            break
        left = end
        column += 1


@compiled
def overlap(covered: Float[np.ndarray, "S S"], target: Target) -> tuple[float, float, float]:
    """L_iou and L_boundary of eq. (3), and the hard IoU, all without unknown pixels."""
    mask, distance, mask_area = target.mask, target.distance, target.mask_area
    unknown, is_hidden = target.unknown, len(target.unknown) > 0
    size = len(mask)
    both = total = boundary = 0.0
    hard_both = hard_total = 0
    for i in range(size):
        for k in range(size):
            c = covered[i, k]
            if c > 0.0 and not (is_hidden and unknown[i, k]):
                total += c
                boundary += c * distance[i, k]
                both += c * mask[i, k]
                if c >= COVERED:
                    hard_total += 1
                    if mask[i, k] > COVERED:
                        hard_both += 1
    iou = both / (total + mask_area - both)
    hard = hard_both / (hard_total + mask_area - hard_both)
    return 1.0 - iou, boundary_loss(boundary, size), hard


@compiled
def boundary_loss(distances_px: float, size: int) -> float:
    """L_boundary of the sum of the distances of all that is covered: `losses.boundary_loss`.

    It is their mean over the picture's pixels, in percent of its side.
    """
    return distances_px * 100.0 / size**3


class VisibleRim(NamedTuple):
    """Rim edges of a body with nothing of the body outside them."""

    edges: Int[np.ndarray, "E 2"]  # vertices
    normals: Float[np.ndarray, "E 2"]  # outward, of length 1
    lengths: Float[np.ndarray, "E"]  # px


class RimSlopes(NamedTuple):
    """Slopes of the pixels of the rim's vertices to the parameters."""

    row_of: Int[np.ndarray, "V"]  # of each vertex, in `slopes`; -1: not on the rim
    slopes: Float[np.ndarray, "C 2 P"]


@compiled
def visible_rim(rendering: Rendering) -> VisibleRim:
    """Rim edges with nothing of the body outside them."""
    pixels, rim, covered = rendering.pixels, rendering.rim, rendering.covered
    size = len(covered)
    keep = np.empty((len(rim), 2), np.int64)
    normals = np.empty((len(rim), 2))
    lengths = np.empty(len(rim))
    count = 0
    for r in range(len(rim)):
        a, b = rim[r, 0], rim[r, 1]
        dx, dy = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        length = np.sqrt(dx * dx + dy * dy)
        if length < 1e-9:
            continue
        nx, ny = dy / length, -dx / length
        column = int(np.rint((pixels[a, 0] + pixels[b, 0]) / 2 + nx))
        row = int(np.rint((pixels[a, 1] + pixels[b, 1]) / 2 + ny))
        if 0 <= row < size and 0 <= column < size and covered[row, column] >= COVERED:
            continue
        keep[count, 0], keep[count, 1] = a, b
        normals[count, 0], normals[count, 1] = nx, ny
        lengths[count] = length
        count += 1
    return VisibleRim(keep[:count], normals[:count], lengths[:count])


@compiled
def rim_slopes(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    points: Float[np.ndarray, "N 3"],
    edges: Int[np.ndarray, "E 2"],
) -> RimSlopes:
    """Slopes of the pixels of these edges' vertices."""
    row_of, chosen = rim_vertices(problem.body.num_vertices, edges)
    slopes = jacobian(problem.body, problem.kind, parameters, chosen)
    return RimSlopes(row_of, pixel_slopes(points, chosen, slopes, problem.target))


@compiled
def rim_vertices(
    num_vertices: int, edges: Int[np.ndarray, "E 2"]
) -> tuple[Int[np.ndarray, "V"], Int[np.ndarray, "C"]]:
    """`RimSlopes.row_of` of every vertex, and the vertices in the order of these rows."""
    row_of = np.full(num_vertices, -1, np.int64)
    chosen = np.empty(2 * len(edges), np.int64)
    count = 0
    for r in range(len(edges)):
        for k in range(2):
            v = edges[r, k]
            if row_of[v] < 0:
                row_of[v] = count
                chosen[count] = v
                count += 1
    return row_of, chosen[:count]


@compiled
def pixel_slopes(
    points: Float[np.ndarray, "N 3"],
    chosen: Int[np.ndarray, "C"],
    slopes: Float[np.ndarray, "C 3 P"],
    target: Target,
) -> Float[np.ndarray, "C 2 P"]:
    """Slopes of the chosen vertices' pixels to the parameters, from the slopes of their points."""
    out = np.empty((len(chosen), 2, slopes.shape[2]))
    fx, fy = target.K[0, 0], target.K[1, 1]
    for c in range(len(chosen)):
        n = chosen[c]
        x, y = points[n, 0] + target.anchor[0], points[n, 1] + target.anchor[1]
        z = points[n, 2] + target.anchor[2]
        for p in range(slopes.shape[2]):
            dz = slopes[c, 2, p] / z
            out[c, 0, p] = fx * (slopes[c, 0, p] - x * dz) / z
            out[c, 1, p] = fy * (slopes[c, 1, p] - y * dz) / z
    return out


# Residuals under half a pixel, the mask's own staircase, have equal weights.
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
    target: Target, pixels: Float[np.ndarray, "V 2"], visible: VisibleRim, moved: RimSlopes
) -> Residuals:
    """Distances between rim and contour, both ways, with their slopes by the slopes in `moved`."""
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
    """Value and unit gradient of a distance field between pixels; it continues outside."""
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
    """Start of each edge, its direction, and one over its squared length."""
    starts, ways = np.empty((len(edges), 2)), np.empty((len(edges), 2))
    scales = np.empty(len(edges))
    for r in range(len(edges)):
        a, b = edges[r, 0], edges[r, 1]
        starts[r, 0], starts[r, 1] = pixels[a, 0], pixels[a, 1]
        ways[r, 0], ways[r, 1] = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        scales[r] = 1.0 / (ways[r, 0] ** 2 + ways[r, 1] ** 2)
    return starts, ways, scales
