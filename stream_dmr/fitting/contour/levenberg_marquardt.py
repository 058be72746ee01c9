"""Damped Gauss-Newton on the contour, with the paper's L_rec deciding which iterate is best."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.compiled import compiled, inlined
from stream_dmr.fitting.contour.deformation import deform
from stream_dmr.fitting.contour.mesh_terms import face_normals, neighbor_offsets, smoothness
from stream_dmr.fitting.contour.normal_equations import normal_equations
from stream_dmr.fitting.contour.outline import Rendering, coverage, overlap, project, rim_edges
from stream_dmr.fitting.contour.problem import LAPLACIAN, NORMAL, Options, Problem
from stream_dmr.fitting.contour.regularisers import prior_loss
from stream_dmr.fitting.contour.rotation_vector import dot
from stream_dmr.fitting.parameters import LOG_SIZE, joints_of

SETTLED, STUCK, EXHAUSTED = 0, 1, 2
STOP_REASONS = ("L_rec settled", "no step lowers L_rec", "iterations used up")

# Damping at the start, a share of the curvature's diagonal: near the answer the model is trusted,
# far from it less. The numbers here were chosen by trial.
WARM_DAMPING, COLD_DAMPING = 1e-2, 1e-1
# The damping is multiplied by these after a refused and an accepted step: raised fast and lowered
# slowly, as by Press et al., "Numerical Recipes", 3rd ed., sec. 15.5, who have 10 and 0.1.
_GROWTH, _SHRINK = 10.0, 0.3
# Consecutive steps, each ten times shorter: what is left to gain is pixel noise.
_MAX_REFUSED = 3


class Minimum(NamedTuple):
    """Where a search ended."""

    parameters: Float[np.ndarray, "P"]  # the best ones
    loss: float  # their L_rec with the priors
    iou: float  # of the hard silhouette
    iterations: int
    stop: int  # why: index of STOP_REASONS
    H: Float[np.ndarray, "P P"]  # curvature of the loss where the last step began, nothing held


class Iterate(NamedTuple):
    """One iterate, with what the normal equations need again."""

    terms: Float[np.ndarray, "6"]  # of eq. (3), before their lambdas
    iou: float  # of the hard silhouette
    rendering: Rendering


@compiled
def evaluate(
    problem: Problem, parameters: Float[np.ndarray, "P"], with_smoothness: bool
) -> Iterate:
    """The six terms of eq. (3) and the hard IoU.

    Without smoothness the last two, L_normal and L_lap, are left at 0: they take a third of it.
    """
    body, target = problem.body, problem.target
    points = deform(body, problem.kind, parameters)
    pixels = project(points[: body.num_vertices], target.anchor, target.K)
    rim = rim_edges(pixels, body)
    covered = coverage(pixels, rim, len(target.mask))
    iou, boundary, hard_iou = overlap(covered, target)
    normal, laplacian, normals, offsets = 0.0, 0.0, np.empty((0, 3)), np.empty((0, 3))
    if with_smoothness:
        normals, offsets = face_normals(points, body.faces), neighbor_offsets(body, points)
        normal, laplacian = smoothness(body, normals, offsets, np.exp(parameters[LOG_SIZE]))
    scale, translation = 0.0, 0.0
    joints = joints_of(parameters)
    for j in range(len(body.joints)):
        scale += (np.exp(joints.log_scale[j]) - 1.0) ** 2
        for i in range(3):
            translation += joints.translation[j, i] ** 2
    terms = np.array([iou, boundary, scale, translation, normal, laplacian])
    return Iterate(terms, hard_iou, Rendering(points, pixels, rim, covered, normals, offsets))


@inlined
def minimise(
    problem: Problem,
    start: Float[np.ndarray, "P"],
    held: Bool[np.ndarray, "P"],
    options: Options,
) -> Minimum:
    """Down from the start; parameters that are `held` keep their value.

    Part of the scan of sizes: from Python, `scan.descend` is the same without a compilation more.
    """
    lambdas, tolerance, damping = problem.lambdas, options.tolerance, options.damping
    with_smoothness = lambdas[NORMAL] > 0 or lambdas[LAPLACIAN] > 0
    best = start.copy()
    here = evaluate(problem, best, with_smoothness)
    loss = _total(here.terms, lambdas) + prior_loss(problem, best)
    H, g = normal_equations(problem, best, here.rendering)
    num_calm, num_refused = 0, 0
    for iteration in range(1, options.iterations + 1):
        step = solve(H, g, damping, held)
        if 0.5 * dot(g, step) < tolerance:
            return Minimum(best, loss, here.iou, iteration - 1, SETTLED, H)
        trial = best - step
        there = evaluate(problem, trial, with_smoothness)
        gain = loss - _total(there.terms, lambdas) - prior_loss(problem, trial)
        if gain > 0:
            best, here = trial, there
            loss -= gain
            damping *= _SHRINK
            num_refused = 0
            num_calm = num_calm + 1 if gain < tolerance else 0
            if num_calm == 2:
                return Minimum(best, loss, here.iou, iteration, SETTLED, H)
            if iteration < options.iterations:
                H, g = normal_equations(problem, best, here.rendering)
        else:
            damping *= _GROWTH
            num_refused += 1
            if num_refused == _MAX_REFUSED:
                return Minimum(best, loss, here.iou, iteration, STUCK, H)
    return Minimum(best, loss, here.iou, options.iterations, EXHAUSTED, H)


@compiled
def _total(terms: Float[np.ndarray, "6"], lambdas: Float[np.ndarray, "6"]) -> float:
    total = 0.0
    for k in range(len(terms)):
        total += terms[k] * lambdas[k]
    return total


@compiled
def solve(
    H: Float[np.ndarray, "P P"],
    g: Float[np.ndarray, "P"],
    damping: float,
    held: Bool[np.ndarray, "P"],
) -> Float[np.ndarray, "P"]:
    """(H + damping diag H)^-1 g, with steps of 0 in the parameters that are held."""
    return solve_factorised(factorise(H, damping, held), without(g, held))


@compiled
def without(g: Float[np.ndarray, "P"], held: Bool[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """A copy with zeros where parameters are held."""
    free = np.empty_like(g)
    for p in range(len(g)):
        free[p] = 0.0 if held[p] else g[p]
    return free


@compiled
def factorise(
    H: Float[np.ndarray, "P P"], damping: float, held: Bool[np.ndarray, "P"]
) -> Float[np.ndarray, "P P"]:
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
def solve_factorised(
    L: Float[np.ndarray, "P P"], g: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "P"]:
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
