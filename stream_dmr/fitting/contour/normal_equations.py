"""The least-squares problem of one iterate: contour residuals, both ways, and the regularisers.

L_iou grows by |d| / A and L_boundary by c d^2 / 2 per pixel of rim that stands a distance d off the
target, with A the mask's area and c the scale of `losses.boundary_loss`. Reweighted least squares
turn both into w d^2 / 2 with w = 1 / (A max(|d|, eps)) + c. The distance is measured both ways,
each with half the weight: from the model's rim by the target's distance map, and from the target's
contour to the nearest rim edge that faces the same way; so that neither a tail left out nor a fin
too many goes unseen.
"""

import numpy as np

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import JOINT, ROOT
from stream_dmr.fitting.contour.deformation import jacobian
from stream_dmr.fitting.contour.mesh_terms import smoothness_slope
from stream_dmr.fitting.contour.rotation import rotation, turn_slope

# Residuals under this are all the same to the reweighting, px: the pixels' own staircase.
_FLAT_PX = 0.5
# Normals of a contour point and its rim edge agree when their cosine is above this.
_SAME_WAY = 0.3
# The joints' common rotation is the root's own: this weight of its square holds that gauge.
_GAUGE = 1e-1


@compiled
def normal_equations(body, kind, target, lambdas, priors, flat, rest, points, pixels, rim, covered):
    """H and g of the quadratic model E(flat + x) = E + g x + x H x / 2."""
    visible, normals, lengths = visible_rim(pixels, rim, covered)
    index, slopes = rim_slopes(body, kind, target, flat, points, visible)
    rows = np.empty((len(visible) + len(target.contour), len(flat)))
    residuals = np.empty(len(rows))
    weights = np.zeros(len(rows))
    _rim_rows(target, pixels, visible, lengths, index, slopes, rows, residuals, weights)
    _contour_rows(
        target, pixels, visible, normals, index, slopes, rows, residuals, weights, len(visible)
    )
    H, g = weighted_squares(rows, residuals, weights)
    _regularise(target, flat, rest, lambdas, priors, H, g)
    if lambdas[4] > 0 or lambdas[5] > 0:
        g += smoothness_slope(body, kind, flat, points, lambdas[4], lambdas[5])
    return H, g


@compiled
def weighted_squares(rows, residuals, weights):
    """H = sum w r r^T and g = sum w r residual, in one fixed order: the same bits every time."""
    count = rows.shape[1]
    H, g = np.zeros((count, count)), np.zeros(count)
    whole = len(rows) // 4 * 4
    for n in range(0, whole, 4):  # four at a time: each entry of H is loaded and stored less often
        r0, r1, r2, r3 = rows[n], rows[n + 1], rows[n + 2], rows[n + 3]
        for p in range(count):
            a0, a1 = weights[n] * r0[p], weights[n + 1] * r1[p]
            a2, a3 = weights[n + 2] * r2[p], weights[n + 3] * r3[p]
            g[p] += a0 * residuals[n] + a1 * residuals[n + 1]
            g[p] += a2 * residuals[n + 2] + a3 * residuals[n + 3]
            for q in range(p + 1):
                H[p, q] += a0 * r0[q] + a1 * r1[q] + a2 * r2[q] + a3 * r3[q]
    for n in range(whole, len(rows)):
        for p in range(count):
            a = weights[n] * rows[n, p]
            g[p] += a * residuals[n]
            for q in range(p + 1):
                H[p, q] += a * rows[n, q]
    for p in range(count):
        for q in range(p):
            H[q, p] = H[p, q]
    return H, g


@compiled
def rim_slopes(body, kind, target, flat, points, visible):
    """Where each vertex's rows are, and slopes of the rim's pixels to the parameters (C, 2, P)."""
    index = np.full(body.num_vertices, -1, np.int64)
    chosen = np.empty(2 * len(visible), np.int64)
    count = 0
    for r in range(len(visible)):
        for k in range(2):
            v = visible[r, k]
            if index[v] < 0:
                index[v] = count
                chosen[count] = v
                count += 1
    chosen = chosen[:count]
    return index, _pixel_slopes(points, chosen, jacobian(body, kind, flat, chosen), target)


@compiled
def visible_rim(pixels, rim, covered):
    """Rim edges with nothing of the body outside them, their outward normals and lengths."""
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
        if 0 <= row < size and 0 <= column < size and covered[row, column] >= 0.5:
            continue
        keep[count, 0], keep[count, 1] = a, b
        normals[count, 0], normals[count, 1] = nx, ny
        lengths[count] = length
        count += 1
    return keep[:count], normals[:count], lengths[:count]


@compiled
def _pixel_slopes(points, chosen, slopes, target):
    """Slopes of the chosen vertices' pixels to the parameters, (C, 2, P)."""
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
def _weight(length, residual, target):
    return (
        0.5
        * length
        * (1.0 / (target.mask_area * max(abs(residual), _FLAT_PX)) + 100.0 / len(target.mask) ** 3)
    )


@compiled
def _rim_rows(target, pixels, visible, lengths, index, slopes, rows, residuals, weights):
    """The model's rim in the target's signed distance field."""
    for r in range(len(visible)):
        a, b = visible[r, 0], visible[r, 1]
        x, y = (pixels[a, 0] + pixels[b, 0]) / 2, (pixels[a, 1] + pixels[b, 1]) / 2
        value, gx, gy = _look_up(target.distance, x, y)
        residuals[r] = value
        weights[r] = _weight(lengths[r], value, target)
        i, j = index[a], index[b]
        for p in range(rows.shape[1]):
            rows[r, p] = 0.5 * (
                gx * (slopes[i, 0, p] + slopes[j, 0, p]) + gy * (slopes[i, 1, p] + slopes[j, 1, p])
            )


@compiled
def _look_up(field, x, y):
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
def _contour_rows(target, pixels, visible, normals, index, slopes, rows, residuals, weights, first):
    """The target's contour to the nearest rim edge that faces the same way."""
    starts, ways, scales = _segments(pixels, visible)
    for c in range(len(target.contour)):
        row = first + c
        qx, qy = target.contour[c, 0], target.contour[c, 1]
        nx, ny = target.contour_normals[c, 0], target.contour_normals[c, 1]
        best, edge, place = np.inf, -1, 0.0
        for r in range(len(visible)):
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
            residuals[row] = 0.0
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
        residuals[row] = gap
        weights[row] = _weight(target.contour_lengths[c], gap, target)
        i, j = index[visible[edge, 0]], index[visible[edge, 1]]
        for p in range(rows.shape[1]):
            rows[row, p] = (1 - place) * (ux * slopes[i, 0, p] + uy * slopes[i, 1, p]) + place * (
                ux * slopes[j, 0, p] + uy * slopes[j, 1, p]
            )


@compiled
def _segments(pixels, visible):
    """Where each rim edge begins, where it leads, and one over its squared length."""
    starts, ways = np.empty((len(visible), 2)), np.empty((len(visible), 2))
    scales = np.empty(len(visible))
    for r in range(len(visible)):
        a, b = visible[r, 0], visible[r, 1]
        starts[r, 0], starts[r, 1] = pixels[a, 0], pixels[a, 1]
        ways[r, 0], ways[r, 1] = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        scales[r] = 1.0 / (ways[r, 0] ** 2 + ways[r, 1] ** 2)
    return starts, ways, scales


@compiled
def _regularise(target, flat, rest, lambdas, priors, H, g):
    """L_s and L_t of eq. (4), the priors, and the gauge."""
    num_joints = (len(flat) - ROOT) // JOINT
    for i in range(3):
        total = 0.0
        for j in range(num_joints):
            total += flat[ROOT + JOINT * j + i]
        for j in range(num_joints):
            g[ROOT + JOINT * j + i] += _GAUGE * total
            for k in range(num_joints):
                H[ROOT + JOINT * j + i, ROOT + JOINT * k + i] += _GAUGE
    for j in range(num_joints):
        base = ROOT + JOINT * j
        for i in range(13):
            _add_square(base + i, flat[base + i] - rest[base + i], 1.0, priors[1 + i], H, g)
        for i in range(3, 6):
            _add_square(base + i, flat[base + i], 1.0, 2 * lambdas[3], H, g)
        scale = np.exp(flat[base + 6])
        _add_square(base + 6, scale - 1.0, scale, 2 * lambdas[2], H, g)
    R, J = rotation(flat[:3])
    A = np.empty((3, 3))
    turn_slope(R, J, np.array([1.0, 0.0, 0.0]), A)
    n = target.plane_normal
    tilt = n[0] * R[0, 0] + n[1] * R[1, 0] + n[2] * R[2, 0]
    slope = n @ A
    for i in range(3):
        g[i] += priors[0] * tilt * slope[i]
        for k in range(3):
            H[i, k] += priors[0] * slope[i] * slope[k]


@compiled
def prior_loss(target, flat, rest, priors):
    """What the priors add to L_rec: half the weighted squares of tilt, bends and weights."""
    R, _ = rotation(flat[:3])
    n = target.plane_normal
    loss = 0.5 * priors[0] * (n[0] * R[0, 0] + n[1] * R[1, 0] + n[2] * R[2, 0]) ** 2
    for p in range(ROOT, len(flat)):
        loss += 0.5 * priors[1 + (p - ROOT) % JOINT] * (flat[p] - rest[p]) ** 2
    return loss


@compiled
def _add_square(p, residual, slope, weight, H, g):
    g[p] += weight * slope * residual
    H[p, p] += weight * slope * slope
