"""What both deformations share: the joints' weights, scales and blends, and the root.

Skinning weights are a softmax of e_j, so that a blend X = sum_j W_j X_j has
dX/de_j = W_j (X_j - X). The layout of the parameters stands in `stream_dmr.fitting.parameters`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.rotation_vector import rotated_slope, rotation_and_jacobian
from stream_dmr.fitting.parameters import LOG_SIZE, ROOT_ROTATION, ROOT_TRANSLATION


@compiled
def cholesky_factors(weight: Float[np.ndarray, "J 6"]) -> Float[np.ndarray, "J 3 3"]:
    """Cholesky factors L of each joint's Q, from its parameters."""
    L = np.zeros((len(weight), 3, 3))
    for j in range(len(weight)):
        for i in range(3):
            L[j, i, i] = np.exp(weight[j, i])
        L[j, 1, 0], L[j, 2, 0], L[j, 2, 1] = weight[j, 3], weight[j, 4], weight[j, 5]
    return L


@compiled
def skinning_weights(
    place: Float[np.ndarray, "3"],
    joints: Float[np.ndarray, "J 3"],
    L: Float[np.ndarray, "J 3 3"],
    W: Float[np.ndarray, "J"],
    dE: Float[np.ndarray, "J 6"],
) -> None:
    """Skinning weights at a place into W, and d e_j / d q_j of the softmax's arguments into dE."""
    num_joints = len(joints)
    top = -np.inf
    for j in range(num_joints):
        u0, u1, u2 = place[0] - joints[j, 0], place[1] - joints[j, 1], place[2] - joints[j, 2]
        y0 = L[j, 0, 0] * u0 + L[j, 1, 0] * u1 + L[j, 2, 0] * u2
        y1 = L[j, 1, 1] * u1 + L[j, 2, 1] * u2
        y2 = L[j, 2, 2] * u2
        W[j] = -0.5 * (y0 * y0 + y1 * y1 + y2 * y2)
        top = max(top, W[j])
        dE[j, 0] = -y0 * u0 * L[j, 0, 0]
        dE[j, 1] = -y1 * u1 * L[j, 1, 1]
        dE[j, 2] = -y2 * u2 * L[j, 2, 2]
        dE[j, 3] = -y0 * u1
        dE[j, 4] = -y0 * u2
        dE[j, 5] = -y1 * u2
    total = 0.0
    for j in range(num_joints):
        W[j] = 1.0 if W[j] == top else np.exp(W[j] - top)
        total += W[j]
    for j in range(num_joints):
        W[j] /= total


@compiled
def blend(
    W: Float[np.ndarray, "J"], values: Float[np.ndarray, "J 3"], out: Float[np.ndarray, "3"]
) -> None:
    """sum_j W_j x_j into `out`."""
    x = y = z = 0.0
    for j in range(len(W)):
        x, y, z = x + W[j] * values[j, 0], y + W[j] * values[j, 1], z + W[j] * values[j, 2]
    out[0], out[1], out[2] = x, y, z


class Root(NamedTuple):
    """The root's own motion: a point p of the body comes to size (R p + shift)."""

    R: Float[np.ndarray, "3 3"]
    J: Float[np.ndarray, "3 3"]  # right Jacobian of the rotation vector
    shift: Float[np.ndarray, "2"]  # x and y
    size: float


@compiled
def root_of(parameters: Float[np.ndarray, "P"]) -> Root:
    """The root's motion by its parameters."""
    R, J = rotation_and_jacobian(parameters[ROOT_ROTATION])
    return Root(R, J, parameters[ROOT_TRANSLATION], np.exp(parameters[LOG_SIZE]))


@compiled
def root_slope(
    root: Root,
    v: Float[np.ndarray, "3"],
    shift: Float[np.ndarray, "3"],
    scale: float,
    c: int,
    out: Float[np.ndarray, "C 3 P"],
    A: Float[np.ndarray, "3 3"],
) -> None:
    """Slope of scale size (R v + shift + T_0) to the root's parameters into `out[c]`.

    A is overwritten.
    """
    R, size = root.R, root.size
    rotated_slope(R, root.J, v, A)
    for i in range(3):
        moved = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2] + shift[i]
        if i < 2:
            moved += root.shift[i]
            out[c, i, ROOT_TRANSLATION.start + i] = size * scale
        for m in range(3):
            out[c, i, ROOT_ROTATION.start + m] = size * scale * A[i, m]
        out[c, i, LOG_SIZE] = size * scale * moved
