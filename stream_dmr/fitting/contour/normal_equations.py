"""The quadratic model of the loss at one iterate: contour, regularisers and priors together."""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.contour_residuals import Residuals, contour_residuals
from stream_dmr.fitting.contour.mesh_terms import smoothness_slope
from stream_dmr.fitting.contour.outline import Rendering
from stream_dmr.fitting.contour.problem import LAPLACIAN, NORMAL, Problem
from stream_dmr.fitting.contour.regularisers import regularise
from stream_dmr.fitting.contour.visible_rim import rim_slopes, visible_rim


@compiled
def normal_equations(
    problem: Problem, parameters: Float[np.ndarray, "P"], rendering: Rendering
) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, "P"]]:
    """H and g of the quadratic model E(parameters + x) = E + g x + x H x / 2."""
    body, kind, lambdas = problem.body, problem.kind, problem.lambdas
    visible = visible_rim(rendering)
    moved = rim_slopes(problem, parameters, rendering.points, visible.edges)
    H, g = weighted_squares(contour_residuals(problem.target, rendering.pixels, visible, moved))
    regularise(problem, parameters, H, g)
    if lambdas[NORMAL] > 0 or lambdas[LAPLACIAN] > 0:
        g += smoothness_slope(
            body,
            kind,
            parameters,
            rendering.points,
            rendering.normals,
            rendering.offsets,
            lambdas[NORMAL],
            lambdas[LAPLACIAN],
        )
    return H, g


@compiled
def weighted_squares(
    residuals: Residuals,
) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, "P"]]:
    """H = sum w r r^T and g = sum w r value, in one fixed order: the same bits every time."""
    rows, values, weights = residuals.rows, residuals.values, residuals.weights
    count = rows.shape[1]
    H, g = np.zeros((count, count)), np.zeros(count)
    whole = len(rows) // 4 * 4
    for n in range(0, whole, 4):  # four at a time: each entry of H is loaded and stored less often
        r0, r1, r2, r3 = rows[n], rows[n + 1], rows[n + 2], rows[n + 3]
        for p in range(count):
            a0, a1 = weights[n] * r0[p], weights[n + 1] * r1[p]
            a2, a3 = weights[n + 2] * r2[p], weights[n + 3] * r3[p]
            g[p] += a0 * values[n] + a1 * values[n + 1]
            g[p] += a2 * values[n + 2] + a3 * values[n + 3]
            for q in range(p + 1):
                H[p, q] += a0 * r0[q] + a1 * r1[q] + a2 * r2[q] + a3 * r3[q]
    for n in range(whole, len(rows)):
        for p in range(count):
            a = weights[n] * rows[n, p]
            g[p] += a * values[n]
            for q in range(p + 1):
                H[p, q] += a * rows[n, q]
    for p in range(count):
        for q in range(p):
            H[q, p] = H[p, q]
    return H, g
