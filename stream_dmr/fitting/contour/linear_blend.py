"""The linear blend of `skinning.py`, eq. (1), with its analytic Jacobian: compiled loops."""

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.joints import (
    blend,
    cholesky_factors,
    root_of,
    root_slope,
    skinning_weights,
)
from stream_dmr.fitting.contour.rotation_vector import (
    dot,
    fill_rotation,
    rotated_slope,
    rotation_and_jacobian,
)
from stream_dmr.fitting.parameters import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    JOINT_WEIGHT,
    LOG_SIZE,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_TRANSLATION,
    joints_of,
)


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
