"""The linear blend of `skinning.py`, eq. (1), with its analytic Jacobian: compiled loops."""

import numpy as np

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import JOINT, ROOT
from stream_dmr.fitting.contour.joints import blend, factors, joint_scales, root_slope, weights
from stream_dmr.fitting.contour.rotation import dot, rotation, turn, turn_slope


@compiled
def blend_points(body, flat):
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
        x, y, z = body.points[n, 0], body.points[n, 1], body.points[n, 2]
        for j in range(num_joints):
            for i in range(3):
                out[n, i] += W[j] * (turns[j, i, 0] * x + turns[j, i, 1] * y + turns[j, i, 2] * z)
    return out


@compiled
def move_and_scale(body, flat, size, out):
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
def blend_jacobian(body, flat, L, chosen, out):
    """Slopes (C, 3, P) of chosen points to the parameters, into `out`."""
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
        root_slope(root, root_J, size, flat, v, shift, scale, out[c], A)
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
