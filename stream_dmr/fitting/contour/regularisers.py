"""L_s and L_t of eq. (4), the priors and the gauge: what a fit minimises beside the contour."""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.problem import SCALE, TRANSLATION, Problem
from stream_dmr.fitting.contour.roll_angle import roll_and_slope
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

# The joints' common rotation is the root's own: this weight of its square holds that gauge.
GAUGE = 1e-1


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
    if priors.roll > 0:
        roll, slope = roll_and_slope(parameters, problem.target.anchor)
        for i in range(3):
            g[i] += priors.roll * roll * slope[i]
            for k in range(3):
                H[i, k] += priors.roll * slope[i] * slope[k]


@compiled
def prior_loss(problem: Problem, parameters: Float[np.ndarray, "P"]) -> float:
    """What the priors add to L_rec: half the weighted squares of what they hold."""
    R, _ = rotation_and_jacobian(parameters[ROOT_ROTATION])
    n, priors = problem.target.plane_normal, problem.priors
    loss = 0.5 * priors.tilt * (n[0] * R[0, 0] + n[1] * R[1, 0] + n[2] * R[2, 0]) ** 2
    for p in range(NUM_ROOT, len(parameters)):
        weight = priors.joint[(p - NUM_ROOT) % NUM_PER_JOINT]
        loss += 0.5 * weight * (parameters[p] - problem.rest[p]) ** 2
    if priors.roll > 0:
        loss += 0.5 * priors.roll * roll_and_slope(parameters, problem.target.anchor)[0] ** 2
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
