"""The spine deformation of `skinning.py` with its analytic Jacobian: compiled loops."""

import numpy as np

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import JOINT, ROOT
from stream_dmr.fitting.contour.joints import blend, factors, joint_scales, root_slope, weights
from stream_dmr.fitting.contour.rotation import (
    apply,
    dot,
    rotation,
    turn,
    turn_and_slope,
    turn_slope,
)


@compiled
def spine_points(body, flat):
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
def spine_jacobian(body, flat, L, chosen, out):
    """Slopes (C, 3, P) of chosen points to the parameters, into `out`."""
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
    R, J = np.empty((3, 3)), np.empty((3, 3))
    local = np.empty((3, JOINT * num_joints))
    for c in range(len(chosen)):
        n = chosen[c]
        u = body.place_of[n]
        weights(body.places[u], body.joints, L, W, dE)
        blend(W, flat, 0, 3, omega)
        blend(W, flat, 3, 3, shift)
        scale = dot(W, S)
        turn_and_slope(omega, R, J)
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
        root_slope(root, root_J, size, flat, v, none, 1.0, out[c], A)
        for i in range(3):
            for p in range(JOINT * num_joints):
                out[c, i, ROOT + p] = size * (
                    root[i, 0] * local[0, p] + root[i, 1] * local[1, p] + root[i, 2] * local[2, p]
                )


@compiled
def spine_nodes(body, flat, L, with_slope):
    """The bent midline from its head, (M, 3), and its slope to the joints' parameters."""
    num_joints, count = len(body.joints), len(body.midline)
    place = np.zeros((count, 3))
    slope = np.zeros((count if with_slope else 0, 3, JOINT * num_joints))
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    omega, step, Rd, middle = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    A, R, J = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(count - 1):
        for i in range(3):
            middle[i] = (body.midline[k, i] + body.midline[k + 1, i]) / 2
        weights(middle, body.joints, L, W, dE)
        blend(W, flat, 0, 3, omega)
        for i in range(3):
            step[i] = body.midline[k + 1, i] - body.midline[k, i]
        turn(omega, R)
        apply(R, step, Rd)
        for i in range(3):
            place[k + 1, i] = place[k, i] + Rd[i]
        if not with_slope:
            continue
        turn_and_slope(omega, R, J)
        turn_slope(R, J, step, A)
        slope[k + 1] = slope[k]
        for j in range(num_joints):
            o, base = JOINT * j, ROOT + JOINT * j
            for i in range(3):
                along = 0.0
                for c in range(3):
                    slope[k + 1, i, o + c] += W[j] * A[i, c]
                    along += A[i, c] * (flat[base + c] - omega[c])
                for q in range(6):
                    slope[k + 1, i, o + 7 + q] += W[j] * along * dE[j, q]
    return place, slope


@compiled
def _at_place(body, nodes, u):
    """Where a place of the midline has gone; also for slopes, which interpolate alike."""
    k, t = body.segments[u], body.fractions[u]
    return (1.0 - t) * nodes[k] + t * nodes[k + 1]
