"""Both deformations of `skinning.py` with their analytic Jacobians, as compiled loops.

The layout of the parameters is `skinning.Parameters`: 6 of the root, then 13 of each joint. The
derivative of a rotated vector is d(R v) = R ((J_r d_omega) x v), with J_r the right Jacobian of the
rotation vector omega (Sola et al., "A micro Lie theory", 2018, eq. (143)). Skinning weights are a
softmax of e_j, so that a blend X = sum_j W_j X_j has dX/de_j = W_j (X_j - X).
"""

import numpy as np

from stream_dmr.body import JOINT, ROOT
from stream_dmr.fitting.compiled import compiled

SPINE, LINEAR_BLEND = 0, 1
KINDS = {"spine": SPINE, "linear-blend": LINEAR_BLEND}


@compiled
def rotation(w):
    """Rotation matrix of a rotation vector, and its right Jacobian."""
    R, J = np.empty((3, 3)), np.empty((3, 3))
    a, b, c = _sines(w)
    _fill(w, a, b, R)
    _fill(w, -b, c, J)
    return R, J


@compiled
def turn(w, R):
    """The rotation matrix alone, into R."""
    a, b, _ = _sines(w)
    _fill(w, a, b, R)


@compiled
def _sines(w):
    """Sin(t) / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of the angle t."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if angle2 < 1e-8:
        return 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    angle = np.sqrt(angle2)
    a = np.sin(angle) / angle
    return a, (1 - np.cos(angle)) / angle2, (1 - a) / angle2


@compiled
def _fill(w, a, b, out):
    """I + a [w]x + b [w]x^2."""
    x, y, z = w[0], w[1], w[2]
    out[0, 0] = 1 - b * (y * y + z * z)
    out[1, 1] = 1 - b * (x * x + z * z)
    out[2, 2] = 1 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x


@compiled
def apply(R, v, out):
    """R v into out: for three numbers faster than a call of BLAS."""
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]


@compiled
def dot(a, b):
    """Scalar product of two short vectors."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled
def factors(flat, num_joints):
    """Cholesky factors L of each joint's Q."""
    L = np.zeros((num_joints, 3, 3))
    for j in range(num_joints):
        q = flat[ROOT + JOINT * j + 7 : ROOT + JOINT * (j + 1)]
        for i in range(3):
            L[j, i, i] = np.exp(q[i])
        L[j, 1, 0], L[j, 2, 0], L[j, 2, 1] = q[3], q[4], q[5]
    return L


@compiled
def weights(place, joints, L, W, dE):
    """Skinning weights W (J,) at a place, and d e_j / d q_j (J, 6) of the softmax's arguments."""
    num_joints = len(joints)
    top = -np.inf
    for j in range(num_joints):
        u0, u1, u2 = place[0] - joints[j, 0], place[1] - joints[j, 1], place[2] - joints[j, 2]
        Lj = L[j]
        y0 = Lj[0, 0] * u0 + Lj[1, 0] * u1 + Lj[2, 0] * u2
        y1 = Lj[1, 1] * u1 + Lj[2, 1] * u2
        y2 = Lj[2, 2] * u2
        W[j] = -0.5 * (y0 * y0 + y1 * y1 + y2 * y2)
        top = max(top, W[j])
        dE[j, 0] = -y0 * u0 * Lj[0, 0]
        dE[j, 1] = -y1 * u1 * Lj[1, 1]
        dE[j, 2] = -y2 * u2 * Lj[2, 2]
        dE[j, 3] = -y0 * u1
        dE[j, 4] = -y0 * u2
        dE[j, 5] = -y1 * u2
    total = 0.0
    for j in range(num_joints):
        W[j] = np.exp(W[j] - top)
        total += W[j]
    for j in range(num_joints):
        W[j] /= total


@compiled
def turn_slope(R, J, v, out):
    """Slope d(R v)/d omega = -R [v]x J_r, a 3x3 matrix."""
    for k in range(3):
        c0 = J[1, k] * v[2] - J[2, k] * v[1]
        c1 = J[2, k] * v[0] - J[0, k] * v[2]
        c2 = J[0, k] * v[1] - J[1, k] * v[0]
        for i in range(3):
            out[i, k] = R[i, 0] * c0 + R[i, 1] * c1 + R[i, 2] * c2


@compiled
def blend(W, flat, column, width, out):
    """sum_j W_j x_j of one kind of joint parameter."""
    out[:] = 0.0
    for j in range(len(W)):
        for k in range(width):
            out[k] += W[j] * flat[ROOT + JOINT * j + column + k]


@compiled
def spine_nodes(body, flat, L, with_slope):
    """The bent midline from its head, (M, 3), and its slope to the joints' parameters."""
    num_joints, count = len(body.joints), len(body.midline)
    S = joint_scales(flat, num_joints)
    place = np.zeros((count, 3))
    slope = np.zeros((count if with_slope else 0, 3, JOINT * num_joints))
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    omega, step, Rd, middle = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    A, R = np.empty((3, 3)), np.empty((3, 3))
    for k in range(count - 1):
        for i in range(3):
            middle[i] = (body.midline[k, i] + body.midline[k + 1, i]) / 2
        weights(middle, body.joints, L, W, dE)
        blend(W, flat, 0, 3, omega)
        for i in range(3):
            step[i] = body.midline[k + 1, i] - body.midline[k, i]
        turn(omega, R)
        apply(R, step, Rd)
        scale = dot(W, S)
        for i in range(3):
            place[k + 1, i] = place[k, i] + scale * Rd[i]
        if not with_slope:
            continue
        R, J = rotation(omega)
        turn_slope(R, J, step, A)
        slope[k + 1] = slope[k]
        for j in range(num_joints):
            o, base = JOINT * j, ROOT + JOINT * j
            for i in range(3):
                along = (S[j] - scale) * Rd[i]
                for c in range(3):
                    slope[k + 1, i, o + c] += W[j] * scale * A[i, c]
                    along += scale * A[i, c] * (flat[base + c] - omega[c])
                slope[k + 1, i, o + 6] += W[j] * S[j] * Rd[i]
                for q in range(6):
                    slope[k + 1, i, o + 7 + q] += W[j] * along * dE[j, q]
    return place, slope


@compiled
def joint_scales(flat, num_joints):
    """S_j of each joint."""
    scales = np.empty(num_joints)
    for j in range(num_joints):
        scales[j] = np.exp(flat[ROOT + JOINT * j + 6])
    return scales


@compiled
def deform(body, kind, flat):
    """Deformed points (N, 3), centered on the root, in units of the root's depth."""
    out = _spine_points(body, flat) if kind == SPINE else _blend_points(body, flat)
    root, _ = rotation(flat[:3])
    size = np.exp(flat[5])
    for n in range(len(out)):
        x, y, z = out[n]
        for i in range(3):
            out[n, i] = root[i, 0] * x + root[i, 1] * y + root[i, 2] * z
    if kind == SPINE:
        for n in range(len(out)):
            out[n, 0] = size * (out[n, 0] + flat[3])
            out[n, 1] = size * (out[n, 1] + flat[4])
            out[n, 2] = size * out[n, 2]
    else:
        _move_and_scale(body, flat, size, out)
    return out


@compiled
def _spine_points(body, flat):
    """Points swept along the bent midline, before the root's own motion."""
    num_joints = len(body.joints)
    L, S = factors(flat, num_joints), joint_scales(flat, num_joints)
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    omega = np.empty(3)
    nodes, _ = spine_nodes(body, flat, L, False)
    center = _at_place(body, nodes, body.place_of[body.num_vertices + 1])
    turns = np.empty((len(body.places), 3, 3))
    bases = np.empty((len(body.places), 3))
    scales = np.empty(len(body.places))
    for u in range(len(body.places)):
        weights(body.places[u], body.joints, L, W, dE)
        blend(W, flat, 0, 3, omega)
        turn(omega, turns[u])
        blend(W, flat, 3, 3, omega)
        apply(turns[u], omega, bases[u])
        k, t = body.segments[u], body.fractions[u]
        for i in range(3):
            bases[u, i] += (1.0 - t) * nodes[k, i] + t * nodes[k + 1, i] - center[i]
        scales[u] = dot(W, S)
    out = np.empty_like(body.points)
    for n in range(len(out)):
        u = body.place_of[n]
        x = scales[u] * (body.points[n, 0] - body.places[u, 0])
        y = scales[u] * (body.points[n, 1] - body.places[u, 1])
        z = scales[u] * (body.points[n, 2] - body.places[u, 2])
        for i in range(3):
            out[n, i] = bases[u, i] + turns[u, i, 0] * x + turns[u, i, 1] * y + turns[u, i, 2] * z
    return out


@compiled
def _blend_points(body, flat):
    """(sum_j W_j R_j) V of eq. (1)."""
    num_joints = len(body.joints)
    L = factors(flat, num_joints)
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    turns = np.empty((num_joints, 3, 3))
    for j in range(num_joints):
        turn(flat[ROOT + JOINT * j : ROOT + JOINT * j + 3], turns[j])
    out = np.zeros_like(body.points)
    for n in range(len(out)):
        weights(body.points[n], body.joints, L, W, dE)
        x, y, z = body.points[n]
        for j in range(num_joints):
            for i in range(3):
                out[n, i] += W[j] * (turns[j, i, 0] * x + turns[j, i, 1] * y + turns[j, i, 2] * z)
    return out


@compiled
def _move_and_scale(body, flat, size, out):
    """S_0 (sum_j W_j S_j) (T_0 + sum_j W_j T_j + V) of eq. (1), in place."""
    num_joints = len(body.joints)
    L, S = factors(flat, num_joints), joint_scales(flat, num_joints)
    W, dE, shift = np.empty(num_joints), np.empty((num_joints, 6)), np.empty(3)
    for n in range(len(out)):
        weights(body.points[n], body.joints, L, W, dE)
        blend(W, flat, 3, 3, shift)
        scale = size * dot(W, S)
        out[n, 0] = scale * (out[n, 0] + shift[0] + flat[3])
        out[n, 1] = scale * (out[n, 1] + shift[1] + flat[4])
        out[n, 2] = scale * (out[n, 2] + shift[2])


@compiled
def _at_place(body, nodes, u):
    """Where a place of the midline has gone; also for slopes, which interpolate alike."""
    k, t = body.segments[u], body.fractions[u]
    return (1.0 - t) * nodes[k] + t * nodes[k + 1]


@compiled
def jacobian(body, kind, flat, chosen):
    """Slopes of the chosen points to the parameters, (C, 3, P)."""
    num_joints = len(body.joints)
    L = factors(flat, num_joints)
    out = np.zeros((len(chosen), 3, len(flat)))
    if kind == SPINE:
        _spine_jacobian(body, flat, L, chosen, out)
    else:
        _blend_jacobian(body, flat, L, chosen, out)
    return out


@compiled
def _spine_jacobian(body, flat, L, chosen, out):
    num_joints = len(body.joints)
    S = joint_scales(flat, num_joints)
    nodes, slopes = spine_nodes(body, flat, L, True)
    middle = body.place_of[body.num_vertices + 1]
    center, center_slope = _at_place(body, nodes, middle), _at_place(body, slopes, middle)
    root, root_J = rotation(flat[:3])
    size = np.exp(flat[5])
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    omega, shift, off, o = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    v, Roff = np.empty(3), np.empty(3)
    A, along, none = np.empty((3, 3)), np.empty(3), np.zeros(3)
    local = np.empty((3, JOINT * num_joints))
    for c in range(len(chosen)):
        n = chosen[c]
        u = body.place_of[n]
        weights(body.places[u], body.joints, L, W, dE)
        blend(W, flat, 0, 3, omega)
        blend(W, flat, 3, 3, shift)
        scale = dot(W, S)
        R, J = rotation(omega)
        for i in range(3):
            off[i] = body.points[n, i] - body.places[u, i]
            o[i] = scale * off[i] + shift[i]
        turn_slope(R, J, o, A)
        apply(R, off, Roff)
        k, t = body.segments[u], body.fractions[u]
        for i in range(3):
            for p in range(JOINT * num_joints):
                local[i, p] = (
                    (1.0 - t) * slopes[k, i, p] + t * slopes[k + 1, i, p] - center_slope[i, p]
                )
        for j in range(num_joints):
            b, base = JOINT * j, ROOT + JOINT * j
            for i in range(3):
                along[i] = (S[j] - scale) * Roff[i]
                for m in range(3):
                    local[i, b + m] += W[j] * A[i, m]
                    local[i, b + 3 + m] += W[j] * R[i, m]
                    along[i] += A[i, m] * (flat[base + m] - omega[m])
                    along[i] += R[i, m] * (flat[base + 3 + m] - shift[m])
                local[i, b + 6] += W[j] * S[j] * Roff[i]
                for q in range(6):
                    local[i, b + 7 + q] += W[j] * along[i] * dE[j, q]
        apply(R, o, v)
        for i in range(3):
            v[i] += (1.0 - t) * nodes[k, i] + t * nodes[k + 1, i] - center[i]
        _root_slope(root, root_J, size, flat, v, none, 1.0, out[c], A)
        for i in range(3):
            for p in range(JOINT * num_joints):
                out[c, i, ROOT + p] = size * (
                    root[i, 0] * local[0, p] + root[i, 1] * local[1, p] + root[i, 2] * local[2, p]
                )


@compiled
def _root_slope(root, root_J, size, flat, v, shift, scale, out, A):
    """Slope of scale size (root v + shift + T_0) to the root's six parameters."""
    turn_slope(root, root_J, v, A)
    for i in range(3):
        moved = root[i, 0] * v[0] + root[i, 1] * v[1] + root[i, 2] * v[2] + shift[i]
        if i < 2:
            moved += flat[3 + i]
            out[i, 3 + i] = size * scale
        for m in range(3):
            out[i, m] = size * scale * A[i, m]
        out[i, 5] = size * scale * moved


@compiled
def _blend_jacobian(body, flat, L, chosen, out):
    num_joints = len(body.joints)
    S = joint_scales(flat, num_joints)
    root, root_J = rotation(flat[:3])
    size = np.exp(flat[5])
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    shift, A, moved = np.empty(3), np.empty((3, 3)), np.empty(3)
    turns, turn_J = np.empty((num_joints, 3, 3)), np.empty((num_joints, 3, 3))
    for j in range(num_joints):
        turns[j], turn_J[j] = rotation(flat[ROOT + JOINT * j : ROOT + JOINT * j + 3])
    for c in range(len(chosen)):
        point = body.points[chosen[c]]
        weights(point, body.joints, L, W, dE)
        blend(W, flat, 3, 3, shift)
        scale = dot(W, S)
        v = np.zeros(3)
        for j in range(num_joints):
            v += W[j] * (turns[j] @ point)
        _root_slope(root, root_J, size, flat, v, shift, scale, out[c], A)
        for i in range(3):
            moved[i] = out[c, i, 5] / (size * scale)
        for j in range(num_joints):
            base = ROOT + JOINT * j
            turn_slope(turns[j], turn_J[j], point, A)
            RA = root @ A
            Rv = root @ (turns[j] @ point - v)
            for i in range(3):
                for m in range(3):
                    out[c, i, base + m] = size * scale * W[j] * RA[i, m]
                out[c, i, base + 3 + i] = size * scale * W[j]
                out[c, i, base + 6] = size * W[j] * S[j] * moved[i]
                along = scale * (Rv[i] + flat[base + 3 + i] - shift[i]) + (S[j] - scale) * moved[i]
                for q in range(6):
                    out[c, i, base + 7 + q] = size * W[j] * along * dE[j, q]
