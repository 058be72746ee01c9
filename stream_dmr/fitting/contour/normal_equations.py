"""The least-squares problem of one iterate: contour residuals, both ways, and the regularisers.

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
from stream_dmr.fitting.contour.deformation import jacobian
from stream_dmr.fitting.contour.mesh_terms import smoothness_slope
from stream_dmr.fitting.contour.outline import COVERED, Rendering, boundary_loss
from stream_dmr.fitting.contour.problem import LAPLACIAN, NORMAL, SCALE, TRANSLATION, Problem
from stream_dmr.fitting.contour.rotation_vector import rotated_slope, rotation_and_jacobian
from stream_dmr.fitting.parameters import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_ROTATION,
    joints_of,
)
from stream_dmr.fitting.target import Target

# Residuals under this are all the same to the reweighting, px: the pixels' own staircase.
_FLAT_PX = 0.5
# Normals of a contour point and its rim edge agree when their cosine is above this.
_SAME_WAY = 0.3
# The joints' common rotation is the root's own: this weight of its square holds that gauge.
GAUGE = 1e-1


class VisibleRim(NamedTuple):
    """Rim edges of a body with nothing of the body outside them."""

    edges: Int[np.ndarray, "E 2"]  # vertices
    normals: Float[np.ndarray, "E 2"]  # outward, of length 1
    lengths: Float[np.ndarray, "E"]  # px


class RimSlopes(NamedTuple):
    """Slopes of the pixels of the rim's vertices to the parameters."""

    row_of: Int[np.ndarray, "V"]  # of each vertex, in `slopes`; -1: not on the rim
    slopes: Float[np.ndarray, "C 2 P"]


class Residuals(NamedTuple):
    """A linear least-squares problem: sum_n weights_n (values_n + rows_n x)^2 / 2."""

    rows: Float[np.ndarray, "N P"]
    values: Float[np.ndarray, "N"]
    weights: Float[np.ndarray, "N"]


@compiled
def normal_equations(
    problem: Problem, parameters: Float[np.ndarray, "P"], rendering: Rendering
) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, "P"]]:
    """H and g of the quadratic model E(parameters + x) = E + g x + x H x / 2."""
    body, kind, lambdas = problem.body, problem.kind, problem.lambdas
    visible = visible_rim(rendering)
    moved = rim_slopes(problem, parameters, rendering.points, visible.edges)
    H, g = weighted_squares(contour_residuals(problem.target, rendering.pixels, visible, moved))
    regularise(problem, parameters, H, g)
    if lambdas[NORMAL] > 0 or lambdas[LAPLACIAN] > 0:
        g += smoothness_slope(
            body, kind, parameters, rendering.points, lambdas[NORMAL], lambdas[LAPLACIAN]
        )
    return H, g


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
def weighted_squares(
    residuals: Residuals,
) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, "P"]]:
    """H = sum w r r^T and g = sum w r value, in one fixed order: the same bits every time."""
    rows, values, weights = residuals.rows, residuals.values, residuals.weights
    count = rows.shape[1]
    H, g = np.zeros((count, count)), np.zeros(count)
    whole = len(rows) // 4 * 4
    for n in range(0, whole, 4):  # four at a time: each entry of H is loaded and stored less often
        r0, r1, r2, r3 = rows[n], rows[n + 1], rows[n + 2], rows[n + 3]
        for p in range(count):
            a0, a1 = weights[n] * r0[p], weights[n + 1] * r1[p]
            a2, a3 = weights[n + 2] * r2[p], weights[n + 3] * r3[p]
            g[p] += a0 * values[n] + a1 * values[n + 1]
            g[p] += a2 * values[n + 2] + a3 * values[n + 3]
            for q in range(p + 1):
                H[p, q] += a0 * r0[q] + a1 * r1[q] + a2 * r2[q] + a3 * r3[q]
    for n in range(whole, len(rows)):
        for p in range(count):
            a = weights[n] * rows[n, p]
            g[p] += a * values[n]
            for q in range(p + 1):
                H[p, q] += a * rows[n, q]
    for p in range(count):
        for q in range(p):
            H[q, p] = H[p, q]
    return H, g


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
        column = int(np.round((pixels[a, 0] + pixels[b, 0]) / 2 + nx))
        row = int(np.round((pixels[a, 1] + pixels[b, 1]) / 2 + ny))
        if 0 <= row < size and 0 <= column < size and covered[row, column] >= COVERED:
            continue
        keep[count, 0], keep[count, 1] = a, b
        normals[count, 0], normals[count, 1] = nx, ny
        lengths[count] = length
        count += 1
    return VisibleRim(keep[:count], normals[:count], lengths[:count])


@compiled
def pixel_slopes(
    points: Float[np.ndarray, "N 3"],
    chosen: Int[np.ndarray, "C"],
    slopes: Float[np.ndarray, "C 3 P"],
    target: Target,
) -> Float[np.ndarray, "C 2 P"]:
    """Slopes of the chosen vertices' pixels to the parameters, from those of their points."""
    out = np.empty((len(chosen), 2, slopes.shape[2]))
    for c in range(len(chosen)):
        n = chosen[c]
        x, y = points[n, 0] + target.anchor[0], points[n, 1] + target.anchor[1]
        z = points[n, 2] + target.anchor[2]
        for p in range(slopes.shape[2]):
            dz = slopes[c, 2, p] / z
            out[c, 0, p] = target.K[0, 0] * (slopes[c, 0, p] - x * dz) / z
            out[c, 1, p] = target.K[1, 1] * (slopes[c, 1, p] - y * dz) / z
    return out


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
            if normals[r, 0] * nx + normals[r, 1] * ny < _SAME_WAY:
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
        if gap > 0.25:
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


@compiled
def regularise(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    H: Float[np.ndarray, "P P"],
    g: Float[np.ndarray, "P"],
) -> None:
    """L_s and L_t of eq. (4), the priors, and the gauge, added to H and g."""
    joints, to_joint = joints_of(parameters), joints_of(g)
    num_joints = len(joints.rotation)
    lambdas, priors = problem.lambdas, problem.priors
    for i in range(3):
        total = 0.0
        for j in range(num_joints):
            total += joints.rotation[j, i]
        first = NUM_ROOT + JOINT_ROTATION.start + i
        for j in range(num_joints):
            to_joint.rotation[j, i] += GAUGE * total
            for k in range(num_joints):
                H[first + NUM_PER_JOINT * j, first + NUM_PER_JOINT * k] += GAUGE
    for j in range(num_joints):
        base = NUM_ROOT + NUM_PER_JOINT * j
        for i in range(len(priors.joint)):
            gap = parameters[base + i] - problem.rest[base + i]
            _add_square(base + i, gap, 1.0, priors.joint[i], H, g)
        for i in range(3):
            shift = joints.translation[j, i]
            p = base + JOINT_TRANSLATION.start + i
            _add_square(p, shift, 1.0, 2 * lambdas[TRANSLATION], H, g)
        scale = np.exp(joints.log_scale[j])
        _add_square(base + JOINT_LOG_SCALE, scale - 1.0, scale, 2 * lambdas[SCALE], H, g)
    R, J = rotation_and_jacobian(parameters[ROOT_ROTATION])
    A = np.empty((3, 3))
    rotated_slope(R, J, np.array([1.0, 0.0, 0.0]), A)
    n = problem.target.plane_normal
    tilt = n[0] * R[0, 0] + n[1] * R[1, 0] + n[2] * R[2, 0]
    slope = n @ A
    for i in range(3):
        g[i] += priors.tilt * tilt * slope[i]
        for k in range(3):
            H[i, k] += priors.tilt * slope[i] * slope[k]


@compiled
def prior_loss(problem: Problem, parameters: Float[np.ndarray, "P"]) -> float:
    """What the priors add to L_rec: half the weighted squares of tilt, bends and weights."""
    R, _ = rotation_and_jacobian(parameters[ROOT_ROTATION])
    n, priors = problem.target.plane_normal, problem.priors
    loss = 0.5 * priors.tilt * (n[0] * R[0, 0] + n[1] * R[1, 0] + n[2] * R[2, 0]) ** 2
    for p in range(NUM_ROOT, len(parameters)):
        weight = priors.joint[(p - NUM_ROOT) % NUM_PER_JOINT]
        loss += 0.5 * weight * (parameters[p] - problem.rest[p]) ** 2
    return loss


@compiled
def _add_square(
    p: int,
    residual: float,
    slope: float,
    weight: float,
    H: Float[np.ndarray, "P P"],
    g: Float[np.ndarray, "P"],
) -> None:
    g[p] += weight * slope * residual
    H[p, p] += weight * slope * slope
