"""The uncertainty of a fit: the covariance of its parameters by the outline's own curvature.

At the optimum each place of the visible rim says how far the outline moves across itself when a
parameter moves. With edges that are off by `edge_std_px` over stretches of `edge_correlation_px`,
those are the rows of a linear least-squares problem whose normal matrix, with the prior, is the
inverse of the covariance. A bend toward the camera moves the outline little and gets a large
variance; so does the length of a fish that may be turned away.
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.contour_residuals import Residuals
from stream_dmr.fitting.contour.deformation import Kind, jacobian
from stream_dmr.fitting.contour.normal_equations import weighted_squares
from stream_dmr.fitting.contour.outline import Rendering
from stream_dmr.fitting.contour.problem import Problem
from stream_dmr.fitting.contour.rotation_vector import dot
from stream_dmr.fitting.contour.visible_rim import rim_slopes, visible_rim
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.parameters import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    JOINT_WEIGHT,
    NUM_PER_JOINT,
)

# What is known of the parameters before any picture, as standard deviations: rotation (rad),
# translation (body lengths) and log scale of the root and of a joint, logs of a joint's precision.
# All are wide, so that the outline decides, but for the joints' scales and translations: the latter
# have the std that L_t means. Chosen by trial; the scan of sizes needs none of them.
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
    joint[JOINT_TRANSLATION] = _translation_precision(settings)
    joint[JOINT_LOG_SCALE] = _JOINT_LOG_SCALE_STD**-2
    joint[JOINT_WEIGHT] = _JOINT_WEIGHT_STD**-2
    return np.concatenate([np.array(_ROOT_STD) ** -2.0, np.tile(joint, num_joints)])


def _translation_precision(settings: FitMeshSettings) -> float:
    """Precision of a joint's translation t by L_t: lambda t^2 in nats is t^2 precision / 2.

    Without priors L_rec is not in nats, and those of the default settings are taken.
    """
    return 2 * settings.lambda_translation / (settings.nat or FitMeshSettings().nat)


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
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    rendering: Rendering,
    weight: float,
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
