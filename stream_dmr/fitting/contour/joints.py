"""What both deformations share: the joints' weights, scales and blends, and the root.

Skinning weights are a softmax of e_j, so that a blend X = sum_j W_j X_j has
dX/de_j = W_j (X_j - X). The layout of the parameters stands in `stream_dmr.fitting.body`.
"""

import numpy as np

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import JOINT, ROOT
from stream_dmr.fitting.contour.rotation import turn_slope


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
def blend(W, flat, column, width, out):
    """sum_j W_j x_j of one kind of joint parameter."""
    out[:] = 0.0
    for j in range(len(W)):
        for k in range(width):
            out[k] += W[j] * flat[ROOT + JOINT * j + column + k]


@compiled
def joint_scales(flat, num_joints):
    """S_j of each joint."""
    scales = np.empty(num_joints)
    for j in range(num_joints):
        scales[j] = np.exp(flat[ROOT + JOINT * j + 6])
    return scales


@compiled
def root_slope(root, root_J, size, flat, v, shift, scale, out, A):
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
