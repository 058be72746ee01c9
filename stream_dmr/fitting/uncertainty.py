"""The uncertainty of a fit: the covariance of its parameters by the outline's own curvature.

At the optimum each place of the visible rim shows how far the outline moves across itself if a
parameter moves. With edges that are off by `edge_std_px` over stretches of `edge_correlation_px`,
these are the rows of a linear least-squares problem whose normal matrix, with the prior, is the
inverse of the covariance. A bend toward the camera moves the outline little and gets a large
variance; so does the length of a fish that may be turned away.
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    JOINT_WEIGHT,
    LOG_SIZE,
    NUM_PER_JOINT,
    Body,
)
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.stock import shape_equations
from stream_dmr.fitting.solver.descent import weighted_squares
from stream_dmr.fitting.solver.linear_blend import dot
from stream_dmr.fitting.solver.outline import Rendering, Residuals, rim_slopes, visible_rim
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.solver.spine import Kind, jacobian

# Stds of the parameters before any picture: rotation (rad), translation (body lengths) and log
# scale of the root and of a joint, logs of a joint's precision. All are wide, so that the outline
# decides, but for the joints' scales and translations: the latter have the std of L_t. Chosen by
# trial; the scan of sizes needs none of them.
_ROOT_STD = [2.0] * 3 + [1.0] * 2 + [1.0]
_JOINT_ROTATION_STD, _JOINT_LOG_SCALE_STD, _JOINT_WEIGHT_STD = 1.0, 0.1, 1.0


def covariance(
    problem: Problem,
    settings: FitMeshSettings,
    parameters: Float[np.ndarray, "P"],
    rendering: Rendering,
) -> Float[np.ndarray, "P P"]:
    """Covariance of the parameters of a fit, from its rendering by `evaluate`."""
    weight = 1.0 / (settings.edge_correlation_px * settings.edge_std_px**2)
    information = _information(problem, parameters, rendering, weight)
    prior = _prior_precisions(settings, len(problem.body.joints))
    spread = np.linalg.inv(information + np.diag(prior))
    return (spread + spread.T) / 2


def _prior_precisions(settings: FitMeshSettings, num_joints: int) -> Float[np.ndarray, "P"]:
    """One over the variances that the parameters have a priori."""
    joint = np.empty(NUM_PER_JOINT)
    joint[JOINT_ROTATION] = _JOINT_ROTATION_STD**-2
    # L_t, lambda t^2 in nats, is t^2 precision / 2.
    joint[JOINT_TRANSLATION] = 2 * settings.lambda_translation / settings.nat
    joint[JOINT_LOG_SCALE] = _JOINT_LOG_SCALE_STD**-2
    joint[JOINT_WEIGHT] = _JOINT_WEIGHT_STD**-2
    return np.concatenate([np.array(_ROOT_STD) ** -2.0, np.tile(joint, num_joints)])


def length_std_ratio(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    points: Float[np.ndarray, "N 3"],
    spread: Float[np.ndarray, "P P"],
) -> float:
    """Std of the arc length as a fraction of it, by the covariance of the parameters."""
    slope = _log_length_slope(problem.body, problem.kind, parameters, points)
    return float(np.sqrt(slope @ spread @ slope))


@compiled
def _information(
    problem: Problem, parameters: Float[np.ndarray, "P"], rendering: Rendering, weight: float
) -> Float[np.ndarray, "P P"]:
    """Sum over the rim of w r r^T, with r the slope (P,) of each edge's middle across itself.

    w is the edge's length times `weight`.
    """
    visible = visible_rim(rendering)
    moved = rim_slopes(problem, parameters, rendering.points, visible.edges)
    slopes, count = moved.slopes, len(visible.edges)
    rows = np.empty((count, len(parameters)))
    for r in range(count):
        i, j = moved.row_of[visible.edges[r, 0]], moved.row_of[visible.edges[r, 1]]
        nx, ny = visible.normals[r] / 2
        for p in range(rows.shape[1]):
            x, y = slopes[i, 0, p] + slopes[j, 0, p], slopes[i, 1, p] + slopes[j, 1, p]
            rows[r, p] = nx * x + ny * y
    information, _ = weighted_squares(Residuals(rows, np.zeros(count), weight * visible.lengths))
    return information


@compiled
def _log_length_slope(
    body: Body, kind: Kind, parameters: Float[np.ndarray, "P"], points: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "P"]:
    """Slope of the log of the midline's arc length, at the fixed depth of the root."""
    chosen = np.arange(body.num_vertices + 3, len(points))
    slopes = jacobian(body, kind, parameters, chosen)
    slope, total = np.zeros(len(parameters)), 0.0
    for m in range(len(chosen) - 1):
        step = points[chosen[m + 1]] - points[chosen[m]]
        length = np.sqrt(dot(step, step))
        total += length
        for i in range(3):
            for p in range(len(parameters)):
                slope[p] += step[i] / length * (slopes[m + 1, i, p] - slopes[m, i, p])
    return slope / total


def freed(settings: FitMeshSettings, breadth_variance: float) -> FitMeshSettings:
    """Settings in which the joints' scales may also differ by the uncertainty of the breadth."""
    return settings.model_copy(
        update={"lambda_scale": settings.freed_lambda_scale(breadth_variance)}
    )


_SLANTS_RAD = np.linspace(0.0, 1.2, 61)


def slant_std_ratio(slant_rad: float, *, slant_std_rad: float, breadth_std: float) -> float:
    """Std of the log length by slant that hides behind a breadth known to `breadth_std` (log).

    A fish of length L that slants by t looks L cos t long, like a fish whose breadth is
    exp(t^2 / 2) times as large. So a body that is taken for too broad is fitted without slant, and
    the slope of its length to its shape, of `shape_std_ratio`, is nil. Here the slant has its
    prior, and the breadth accounts for the rest.
    """
    lengths = -np.log(np.cos(_SLANTS_RAD))
    broader = lengths + np.log(np.cos(min(abs(slant_rad), _SLANTS_RAD[-1])))
    nats = 0.5 * (_SLANTS_RAD / slant_std_rad) ** 2 + 0.5 * (broader / breadth_std) ** 2
    weights = np.exp(nats.min() - nats)
    weights /= weights.sum()
    return float(np.sqrt(weights @ lengths**2 - (weights @ lengths) ** 2))


def shape_std_ratio(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    directions: Float[np.ndarray, "V 3 W"],
    covariance: Float[np.ndarray, "W W"],
) -> float:
    """Std of the log length of a fitted mask by this covariance of the shape's coefficients.

    If the pose is refitted, H_pp dp + H_ps ds = 0, so the length moves by the row of the log size
    in -H_pp^-1 H_ps. All frames of a fish move alike, so the std does not average out.
    """
    H = shape_equations(problem, parameters, directions).H
    num_pose = len(parameters)
    unit = np.zeros(num_pose)
    unit[LOG_SIZE] = 1.0
    # Only one row of the inverse is needed; undetermined parameters don't move.
    pose_H = H[:num_pose, :num_pose] + 1e-12 * np.eye(num_pose)
    slope = -np.linalg.solve(pose_H, unit) @ H[:num_pose, num_pose:]
    return float(np.sqrt(max(slope @ covariance @ slope, 0.0)))


def form_std_ratio(log_sizes: Float[np.ndarray, "K"], nats: Float[np.ndarray, "K"]) -> float:
    """Std of a log size if any of K shapes may be the fish's own.

    The second term of the law of total variance: the variance of the sizes by each shape, weighed
    by its probability, exp(-nats) over their sum. The first term is the variance by the likeliest
    shape. `nats` may be infinite.
    """
    weights = np.exp(nats.min() - nats)
    weights /= weights.sum()
    return float(np.sqrt(weights @ (log_sizes - weights @ log_sizes) ** 2))
