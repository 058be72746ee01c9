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
from stream_dmr.fitting.body import JOINT, ROOT, Body
from stream_dmr.fitting.contour.deformation import KINDS, jacobian
from stream_dmr.fitting.contour.normal_equations import rim_slopes, visible_rim, weighted_squares
from stream_dmr.fitting.contour.rotation import dot
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.target import Target

# What is known of the parameters before any picture, as standard deviations: rotations of the root
# and the joints (rad), their translations (body lengths), log scales, log precisions.
_ROOT_PRIOR = [2.0] * 3 + [1.0] * 2 + [1.0]
_JOINT_PRIOR = [1.0] * 3 + [0.013] * 3 + [0.1] + [1.0] * 6


def covariance(
    body: Body,
    target: Target,
    settings: FitMeshSettings,
    flat: Float[np.ndarray, "P"],
    *,
    points: Float[np.ndarray, "N 3"],
    pixels: Float[np.ndarray, "V 2"],
    rim: np.ndarray,
    covered: Float[np.ndarray, "S S"],
) -> tuple[Float[np.ndarray, "P P"], float]:
    """Covariance of the parameters of a fit, and the std of its length as a fraction of it.

    `points` to `covered` are what `levenberg_marquardt.evaluate` returns for `flat`.
    """
    kind = KINDS[settings.deformation]
    visible, normals, lengths = visible_rim(pixels, rim, covered)
    weight = 1.0 / (settings.edge_correlation_px * settings.edge_std_px**2)
    information = _information(body, kind, target, flat, points, visible, normals, weight * lengths)
    num_joints = (len(flat) - ROOT) // JOINT
    prior = np.array(_ROOT_PRIOR + _JOINT_PRIOR * num_joints)
    spread = np.linalg.inv(information + np.diag(prior**-2.0))
    spread = (spread + spread.T) / 2
    slope = _log_length_slope(body, kind, flat, points)
    return spread, float(np.sqrt(slope @ spread @ slope))


@compiled
def _information(body, kind, target, flat, points, visible, normals, weights):
    """Sum over the rim of w r r^T, with r the slope (P,) of each edge's middle across itself."""
    index, slopes = rim_slopes(body, kind, target, flat, points, visible)
    rows = np.empty((len(visible), len(flat)))
    for r in range(len(visible)):
        i, j = index[visible[r, 0]], index[visible[r, 1]]
        nx, ny = normals[r] / 2
        for p in range(rows.shape[1]):
            x, y = slopes[i, 0, p] + slopes[j, 0, p], slopes[i, 1, p] + slopes[j, 1, p]
            rows[r, p] = nx * x + ny * y
    information, _ = weighted_squares(rows, np.zeros(len(rows)), weights)
    return information


@compiled
def _log_length_slope(body, kind, flat, points):
    """Slope (P,) of the log of the midline's arc length, at the fixed depth of the root."""
    chosen = np.arange(body.num_vertices + 3, len(points))
    slopes = jacobian(body, kind, flat, chosen)
    slope, total = np.zeros(len(flat)), 0.0
    for m in range(len(chosen) - 1):
        step = points[chosen[m + 1]] - points[chosen[m]]
        length = np.sqrt(dot(step, step))
        total += length
        for i in range(3):
            for p in range(len(flat)):
                slope[p] += step[i] / length * (slopes[m + 1, i, p] - slopes[m, i, p])
    return slope / total
