"""The paper's linear blend skinning, and the kernels that both deformations share.

Rotation vectors, their matrices and slopes: compiled loops.

The derivative of a rotated vector is d(R v) = R ((J_r d_omega) x v), with J_r the right Jacobian of
the rotation vector omega (Sola et al., "A micro Lie theory", 2018, eq. (143)).

Skinning weights are a softmax of e_j, so that a blend X = sum_j W_j X_j has
dX/de_j = W_j (X_j - X). The layout of the parameters is in `stream_dmr.fitting.body`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    JOINT_WEIGHT,
    LOG_SIZE,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_ROTATION,
    ROOT_TRANSLATION,
    Body,
    joints_of,
)

Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]


@compiled
def rotation_and_jacobian(w: Vector) -> tuple[Matrix, Matrix]:
    """Rotation matrix of a rotation vector, and its right Jacobian."""
    R, J = np.empty((3, 3)), np.empty((3, 3))
    fill_rotation_and_jacobian(w, R, J)
    return R, J


@compiled
def fill_rotation_and_jacobian(w: Vector, R: Matrix, J: Matrix) -> None:
    """The same into R and J: loops must not allocate."""
    a, b, c = _sines(w)
    _fill(w, a, b, R)
    _fill(w, -b, c, J)


@compiled
def fill_rotation(w: Vector, R: Matrix) -> None:
    """The rotation matrix alone, into R."""
    a, b, _ = _sines(w)
    _fill(w, a, b, R)


@compiled
def _sines(w: Vector) -> tuple[float, float, float]:
    """Sin(t) / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of the angle t."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if angle2 < 1e-8:
        return 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    angle = np.sqrt(angle2)
    a = np.sin(angle) / angle
    return a, (1 - np.cos(angle)) / angle2, (1 - a) / angle2


@compiled
def _fill(w: Vector, a: float, b: float, out: Matrix) -> None:
    """I + a [w]x + b [w]x^2."""
    x, y, z = w[0], w[1], w[2]
    out[0, 0] = 1 - b * (y * y + z * z)
    out[1, 1] = 1 - b * (x * x + z * z)
    out[2, 2] = 1 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x


@compiled
def multiply(R: Matrix, v: Vector, out: Vector) -> None:
    """R v into out: for three numbers faster than a call of BLAS."""
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]


@compiled
def dot(a: Float[np.ndarray, "N"], b: Float[np.ndarray, "N"]) -> float:
    """Scalar product of two short vectors."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled
def rotated_slope(R: Matrix, J: Matrix, v: Vector, out: Matrix) -> None:
    """Slope d(R v)/d omega = -R [v]x J_r into `out`."""
    for k in range(3):
        c0 = J[1, k] * v[2] - J[2, k] * v[1]
        c1 = J[2, k] * v[0] - J[0, k] * v[2]
        c2 = J[0, k] * v[1] - J[1, k] * v[0]
        for i in range(3):
            out[i, k] = R[i, 0] * c0 + R[i, 1] * c1 + R[i, 2] * c2


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


@compiled
def blend_points(body: Body, parameters: Float[np.ndarray, "P"]) -> Float[np.ndarray, "N 3"]:
    """(sum_j W_j R_j) V of eq. (1)."""
    num_joints, joints = len(body.joints), joints_of(parameters)
    L = cholesky_factors(joints.weight)
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    turns = np.empty((num_joints, 3, 3))
    for j in range(num_joints):
        fill_rotation(joints.rotation[j], turns[j])
    out = np.zeros_like(body.points)
    for n in range(len(out)):
        skinning_weights(body.points[n], body.joints, L, W, dE)
        x, y, z = body.points[n, 0], body.points[n, 1], body.points[n, 2]
        for j in range(num_joints):
            for i in range(3):
                out[n, i] += W[j] * (turns[j, i, 0] * x + turns[j, i, 1] * y + turns[j, i, 2] * z)
    return out


@compiled
def move_and_scale(
    body: Body, parameters: Float[np.ndarray, "P"], size: float, out: Float[np.ndarray, "N 3"]
) -> None:
    """S_0 (sum_j W_j S_j) (T_0 + sum_j W_j T_j + V) of eq. (1), in place."""
    num_joints, joints = len(body.joints), joints_of(parameters)
    L, S = cholesky_factors(joints.weight), np.exp(joints.log_scale)
    root_shift = parameters[ROOT_TRANSLATION]
    W, dE, shift = np.empty(num_joints), np.empty((num_joints, 6)), np.empty(3)
    for n in range(len(out)):
        skinning_weights(body.points[n], body.joints, L, W, dE)
        blend(W, joints.translation, shift)
        scale = size * dot(W, S)
        out[n, 0] = scale * (out[n, 0] + shift[0] + root_shift[0])
        out[n, 1] = scale * (out[n, 1] + shift[1] + root_shift[1])
        out[n, 2] = scale * (out[n, 2] + shift[2])


@compiled
def blend_jacobian(
    body: Body,
    parameters: Float[np.ndarray, "P"],
    chosen: Int[np.ndarray, "C"],
    out: Float[np.ndarray, "C 3 P"],
) -> None:
    """Slopes of chosen points to the parameters, into `out`."""
    num_joints, joints = len(body.joints), joints_of(parameters)
    L, S = cholesky_factors(joints.weight), np.exp(joints.log_scale)
    root = root_of(parameters)
    size = root.size
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    shift, A, moved = np.empty(3), np.empty((3, 3)), np.empty(3)
    turns, turn_J = np.empty((num_joints, 3, 3)), np.empty((num_joints, 3, 3))
    for j in range(num_joints):
        turns[j], turn_J[j] = rotation_and_jacobian(joints.rotation[j])
    for c in range(len(chosen)):
        point = body.points[chosen[c]]
        skinning_weights(point, body.joints, L, W, dE)
        blend(W, joints.translation, shift)
        scale = dot(W, S)
        v = np.zeros(3)
        for j in range(num_joints):
            v += W[j] * (turns[j] @ point)
        root_slope(root, v, shift, scale, c, out, A)
        for i in range(3):
            moved[i] = out[c, i, LOG_SIZE] / (size * scale)
        for j in range(num_joints):
            to_joint = out[c, :, NUM_ROOT + NUM_PER_JOINT * j :]
            to_rotation, to_translation = (
                to_joint[:, JOINT_ROTATION],
                to_joint[:, JOINT_TRANSLATION],
            )
            to_weight = to_joint[:, JOINT_WEIGHT]
            rotated_slope(turns[j], turn_J[j], point, A)
            RA = root.R @ A
            Rv = root.R @ (turns[j] @ point - v)
            for i in range(3):
                for m in range(3):
                    to_rotation[i, m] = size * scale * W[j] * RA[i, m]
                to_translation[i, i] = size * scale * W[j]
                to_joint[i, JOINT_LOG_SCALE] = size * W[j] * S[j] * moved[i]
                along = scale * (Rv[i] + joints.translation[j, i] - shift[i])
                along += (S[j] - scale) * moved[i]
                for q in range(6):
                    to_weight[i, q] = size * W[j] * along * dE[j, q]
