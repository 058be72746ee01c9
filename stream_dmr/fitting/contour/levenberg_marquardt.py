"""Damped Gauss-Newton on the contour, with the paper's L_rec deciding which iterate is best."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import JOINT, ROOT
from stream_dmr.fitting.contour.deformation import deform
from stream_dmr.fitting.contour.mesh_terms import smoothness
from stream_dmr.fitting.contour.normal_equations import normal_equations, prior_loss
from stream_dmr.fitting.contour.outline import coverage, overlap, project, rim_edges
from stream_dmr.fitting.contour.rotation import dot

SETTLED, STUCK, EXHAUSTED = 0, 1, 2
STOP_REASONS = ("L_rec settled", "no step lowers L_rec", "iterations used up")

# Damping at the start: near the answer the model is trusted, far from it less.
NEAR, FAR = 1e-2, 1e-1
_GROWTH, _SHRINK = 10.0, 0.3
_MOST_REFUSED = 3  # steps in a row, each ten times shorter: what is left to gain is pixel noise


class Minimum(NamedTuple):
    """Where a search ended."""

    flat: Float[np.ndarray, "P"]  # the best parameters
    loss: float  # their L_rec with the priors
    iou: float  # of the hard silhouette
    iterations: int
    stop: int  # why: index of STOP_REASONS
    H: Float[np.ndarray, "P P"]  # curvature of the loss where the last step began, nothing held


@compiled
def evaluate(body, kind, target, flat, is_smooth):
    """The six terms of eq. (3) and the hard IoU, with what the normal equations need again.

    Without `is_smooth` the last two, L_normal and L_lap, are left at 0: they take a third of it.
    """
    points = deform(body, kind, flat)
    pixels = project(points[: body.num_vertices], target.anchor, target.K)
    rim = rim_edges(pixels, body.faces, body.edges, body.edge_faces)
    covered = coverage(pixels, rim, len(target.mask))
    iou, boundary, hard = overlap(covered, target.mask, target.distance, target.mask_area)
    normal, laplacian = 0.0, 0.0
    if is_smooth:
        normal, laplacian = smoothness(body, points, np.exp(flat[5]))
    scale, translation = 0.0, 0.0
    for j in range(len(body.joints)):
        base = ROOT + JOINT * j
        scale += (np.exp(flat[base + 6]) - 1.0) ** 2
        for i in range(3, 6):
            translation += flat[base + i] ** 2
    terms = np.array([iou, boundary, scale, translation, normal, laplacian])
    return terms, hard, points, pixels, rim, covered


@compiled
def minimise(
    body, kind, target, lambdas, priors, start, rest, held, iterations, tolerance, damping
):
    """Down from the start, in `iterations` steps at the most; what is `held` (P,) stays."""
    flat = start.copy()
    is_smooth = lambdas[4] > 0 or lambdas[5] > 0
    terms, hard, points, pixels, rim, covered = evaluate(body, kind, target, flat, is_smooth)
    loss = np.sum(terms * lambdas) + prior_loss(target, flat, rest, priors)
    H, g = normal_equations(
        body, kind, target, lambdas, priors, flat, rest, points, pixels, rim, covered
    )
    calm, refused = 0, 0
    for iteration in range(1, iterations + 1):
        step = solve(H, g, damping, held)
        if 0.5 * dot(g, step) < tolerance:
            return Minimum(flat, loss, hard, iteration - 1, SETTLED, H)
        trial = flat - step
        found = evaluate(body, kind, target, trial, is_smooth)
        gain = loss - np.sum(found[0] * lambdas) - prior_loss(target, trial, rest, priors)
        if gain > 0:
            flat = trial
            loss -= gain
            terms, hard, points, pixels, rim, covered = found
            damping *= _SHRINK
            refused = 0
            calm = calm + 1 if gain < tolerance else 0
            if calm == 2:
                return Minimum(flat, loss, hard, iteration, SETTLED, H)
            if iteration < iterations:
                H, g = normal_equations(
                    body, kind, target, lambdas, priors, flat, rest, points, pixels, rim, covered
                )
        else:
            damping *= _GROWTH
            refused += 1
            if refused == _MOST_REFUSED:
                return Minimum(flat, loss, hard, iteration, STUCK, H)
    return Minimum(flat, loss, hard, iterations, EXHAUSTED, H)


@compiled
def solve(H, g, damping, held):
    """(H + damping diag H)^-1 g, with steps of 0 in the parameters that are held."""
    return solve_factorised(factorise(H, damping, held), np.where(held, 0.0, g))


@compiled
def factorise(H, damping, held):
    """Lower triangular L with L L^T = H + damping diag H: H is a sum of squares, so it exists.

    Rows and columns of what is held are those of the unit matrix.
    """
    L = H.copy()
    for p in range(len(H)):
        L[p, p] += damping * H[p, p] + 1e-12
        if held[p]:
            L[p] = 0.0
            L[:, p] = 0.0
            L[p, p] = 1.0
    for p in range(len(H)):
        for q in range(p + 1):
            total = L[p, q]
            for k in range(q):
                total -= L[p, k] * L[q, k]
            L[p, q] = np.sqrt(max(total, 1e-30)) if p == q else total / L[q, q]
    return L


@compiled
def solve_factorised(L, g):
    """(L L^T)^-1 g."""
    x = g.copy()
    count = len(g)
    for p in range(count):
        for k in range(p):
            x[p] -= L[p, k] * x[k]
        x[p] /= L[p, p]
    for p in range(count - 1, -1, -1):
        for k in range(p + 1, count):
            x[p] -= L[k, p] * x[k]
        x[p] /= L[p, p]
    return x
