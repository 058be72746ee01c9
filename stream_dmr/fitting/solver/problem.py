"""One fitting problem and its priors, as tuples that compiled loops take."""

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_ROTATION,
    Body,
    Priors,
    joints_of,
    rest_vector,
)
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.solver.linear_blend import dot, rotated_slope, rotation_and_jacobian
from stream_dmr.fitting.solver.spine import KINDS, Kind
from stream_dmr.fitting.target import Target

# The terms of eq. (3), and their lambdas, in this order.
IOU, BOUNDARY, SCALE, TRANSLATION, NORMAL, LAPLACIAN = range(6)


class Problem(NamedTuple):
    """L_rec of eq. (3) of one body on one target, with priors on its parameters.

    Kernels take it as an argument: `stream_dmr.compiled`.
    """

    body: Body
    kind: Kind  # of the deformation: SPINE or LINEAR_BLEND
    target: Target
    lambdas: Float[np.ndarray, "6"]
    priors: Priors
    rest: Float[np.ndarray, "P"]  # the minimum of the priors

    @classmethod
    def from_settings(
        cls, settings: FitMeshSettings, body: Body, target: Target, *, with_smoothness: bool
    ) -> "Problem":
        """Without smoothness: no L_normal and L_lap, expensive terms that separate no poses."""
        # Frozen settings have a hash, which pydantic does not declare.
        lambdas, priors = _weights(settings, with_smoothness)  # pyright: ignore[reportArgumentType]
        shift_std = settings.edge_shift_px / target.half_breadth_px  # of the log breadth
        if shift_std > 0:
            lambdas = lambdas.copy()
            lambdas[SCALE] = settings.freed_lambda_scale(shift_std**2)
        kind, rest = KINDS[settings.deformation], _rest(len(body.joints))
        return cls(body, kind, target, lambdas, priors, rest)


@lru_cache(maxsize=64)
def _weights(
    settings: FitMeshSettings, with_smoothness: bool
) -> tuple[Float[np.ndarray, "6"], Priors]:
    """The lambdas and priors of these settings, equal for the six problems of each crop."""
    lambdas = settings.lambdas()
    if not with_smoothness:
        lambdas[[NORMAL, LAPLACIAN]] = 0.0
    return lambdas, settings.priors()


@cache
def _rest(num_joints: int) -> Float[np.ndarray, "P"]:
    return rest_vector(num_joints)


class Options(NamedTuple):
    """The options of one descent."""

    iterations: int  # at most
    tolerance: float  # of L_rec: it has settled when it falls by less
    damping: float  # of the first step, as a share of the curvature's diagonal


@compiled
def roll_and_slope(
    pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]
) -> tuple[float, Float[np.ndarray, "3"]]:
    """How far the broad side that is seen is turned from the ray through `anchor`, -pi/2 to pi/2.

    And the slope of that to the root's rotation, by the right Jacobian J of SO(3) (Sola et al., "A
    micro Lie theory", 2018). A turn of the body by +r about its x axis, head to tail reversed or
    not, lowers the roll by r.
    """
    # Copied, since arrays of messages are read-only: for numba another type, compiled once more.
    R, J = rotation_and_jacobian(pose[ROOT_ROTATION].copy())
    ray, slope = np.empty(3), np.empty(3)
    for i in range(3):
        ray[i] = dot(R[:, i], anchor)
    ray /= np.sqrt(dot(anchor, anchor))
    if ray[2] < 0:
        ray = -ray
    x, y, z = ray[0], ray[1], ray[2]
    across = max(y * y + z * z, 1e-12)
    for i in range(3):
        slope[i] = x * (y * J[1, i] + z * J[2, i]) / across - J[0, i]
    return np.arctan2(-y, z), slope


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
    """The priors' part of L_rec: half the weighted squares of the parameters that they hold."""
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
