"""How sure a fit is: the covariance of its parameters by the outline's own curvature.

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
from stream_dmr.fitting.contour.deformation import jacobian
from stream_dmr.fitting.contour.normal_equations import (
    Residuals,
    rim_slopes,
    visible_rim,
    weighted_squares,
)
from stream_dmr.fitting.contour.outline import Rendering
from stream_dmr.fitting.contour.problem import Problem
from stream_dmr.fitting.contour.rotation_vector import dot
from stream_dmr.fitting.fit_settings import FitMeshSettings

# What is known of the parameters before any picture, as standard deviations: rotations of the root
# and the joints (rad), their translations (body lengths), log scales, log precisions.
_ROOT_PRIOR = [2.0] * 3 + [1.0] * 2 + [1.0]
_JOINT_PRIOR = [1.0] * 3 + [0.013] * 3 + [0.1] + [1.0] * 6


def covariance(
    problem: Problem,
    settings: FitMeshSettings,
    parameters: Float[np.ndarray, "P"],
    rendering: Rendering,
) -> Float[np.ndarray, "P P"]:
    """Covariance of the parameters of a fit, from its rendering by `evaluate`."""
    weight = 1.0 / (settings.edge_correlation_px * settings.edge_std_px**2)
    information = _information(problem, parameters, rendering, weight)
    num_joints = len(problem.body.joints)
    prior = np.array(_ROOT_PRIOR + _JOINT_PRIOR * num_joints)
    spread = np.linalg.inv(information + np.diag(prior**-2.0))
    return (spread + spread.T) / 2


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
    body: Body, kind: int, parameters: Float[np.ndarray, "P"], points: Float[np.ndarray, "N 3"]
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
