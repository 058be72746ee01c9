"""Levenberg-Marquardt descent on the normal equations, and a scan over sizes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.compiled import compiled, inlined
from stream_dmr.fitting.body import LOG_SIZE, joints_of
from stream_dmr.fitting.solver.linear_blend import dot
from stream_dmr.fitting.solver.mesh_terms import (
    face_normals,
    neighbor_offsets,
    smoothness,
    smoothness_slope,
)
from stream_dmr.fitting.solver.outline import (
    Rendering,
    Residuals,
    contour_residuals,
    coverage,
    overlap,
    project,
    rim_edges,
    rim_slopes,
    visible_rim,
)
from stream_dmr.fitting.solver.problem import (
    LAPLACIAN,
    NORMAL,
    Options,
    Problem,
    prior_loss,
    regularise,
)
from stream_dmr.fitting.solver.spine import deform


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


SETTLED, STUCK, EXHAUSTED = 0, 1, 2
STOP_REASONS = ("L_rec settled", "no step lowers L_rec", "iterations used up")

# Damping at the start, a share of the curvature's diagonal: near the answer the model is trusted,
# far from it less. The numbers here were chosen by trial.
WARM_DAMPING, COLD_DAMPING = 1e-2, 1e-1
# The damping is multiplied by these after a refused and an accepted step: raised fast and lowered
# slowly, as by Press et al., "Numerical Recipes", 3rd ed., sec. 15.5, who have 10 and 0.1.
GROWTH, SHRINK = 10.0, 0.3
# Consecutive steps, each ten times shorter: only pixel noise is left to gain.
MAX_REFUSED = 3


class Minimum(NamedTuple):
    """The end of a search."""

    parameters: Float[np.ndarray, "P"]  # the best of the search
    loss: float  # their L_rec with the priors
    iou: float  # of the hard silhouette
    iterations: int
    stop: int  # why: index of STOP_REASONS
    H: Float[np.ndarray, "P P"]  # curvature of the loss at the start of the last step, nothing held


class Iterate(NamedTuple):
    """One iterate, with all that the normal equations need again."""

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
    problem: Problem, start: Float[np.ndarray, "P"], held: Bool[np.ndarray, "P"], options: Options
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
            damping *= SHRINK
            num_refused = 0
            num_calm = num_calm + 1 if gain < tolerance else 0
            if num_calm == 2:
                return Minimum(best, loss, here.iou, iteration, SETTLED, H)
            if iteration < options.iterations:
                H, g = normal_equations(problem, best, here.rendering)
        else:
            damping *= GROWTH
            num_refused += 1
            if num_refused == MAX_REFUSED:
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

    Rows and columns of held parameters are those of the unit matrix.
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


_ONE_SIZE = np.zeros(1)


class SizeScan(NamedTuple):
    """The best fits of G sizes."""

    parameters: Float[np.ndarray, "G P"]
    losses: Float[np.ndarray, "G"]  # infinite if not tried
    log_volumes: Float[np.ndarray, "G"]
    next_steps: Float[np.ndarray, "G P"]
    start: Minimum  # at the start's own size


def descend(
    problem: Problem, start: Float[np.ndarray, "P"], held: Bool[np.ndarray, "P"], options: Options
) -> Minimum:
    """`minimise`, as the scan of one size: so that it is compiled once for both."""
    # Copied, since arrays of messages are read-only: for numba another type, compiled once more.
    return scan_sizes(problem, start.copy(), held, _ONE_SIZE, 0.0, options).start


@compiled
def scan_sizes(
    problem: Problem,
    start: Float[np.ndarray, "P"],
    held: Bool[np.ndarray, "P"],
    offsets: Float[np.ndarray, "G"],
    max_excess: float,
    options: Options,
) -> SizeScan:
    """Refit at each log size `start[LOG_SIZE] + offsets` (ascending, 0 among them).

    From the start outwards, each size begins where its neighbour's fit is headed; the scan ends at
    sizes whose loss exceeds the start's by `max_excess`. `held` is `only_size`, for several sizes.
    """
    count, middle = len(offsets), 0
    while offsets[middle] < 0.0:
        middle += 1
    fits, next_steps = np.zeros((count, len(start))), np.zeros((count, len(start)))
    losses, log_volumes = np.full(count, np.inf), np.zeros(count)
    guess, n, step = start.copy(), middle, 1
    while True:
        found = minimise(problem, guess, held, options)
        if n == middle:
            first = found
        L = factorise(found.H, 0.0, held)
        next_step = solve_factorised(L, -without(found.H[LOG_SIZE], held))
        next_step[LOG_SIZE] = 1.0
        losses[n] = found.loss
        for p in range(len(start)):
            log_volumes[n] += np.log(L[p, p])
            fits[n, p], next_steps[n, p] = found.parameters[p], next_step[p]
        if not _goes_on(n + step, n, losses, losses[middle] + max_excess):
            n, step = (middle, -1) if step == 1 else (n, 0)
            if step == 0 or not _goes_on(middle - 1, middle, losses, losses[middle] + max_excess):
                break
        n += step
        for p in range(len(start)):
            ahead = (offsets[n] - offsets[n - step]) * next_steps[n - step, p]
            guess[p] = fits[n - step, p] + ahead
        guess[LOG_SIZE] = start[LOG_SIZE] + offsets[n]
    return SizeScan(fits, losses, log_volumes, next_steps, first)  # pyright: ignore[reportPossiblyUnboundVariable]


@compiled
def _goes_on(n: int, before: int, losses: Float[np.ndarray, "G"], limit: float) -> bool:
    """True if there is an n-th size, and the size before it is likely enough."""
    return 0 <= n < len(losses) and losses[before] < limit


@compiled
def only_size(num_parameters: int) -> Bool[np.ndarray, "P"]:
    """The mask of parameters that holds the size alone."""
    held = np.zeros(num_parameters, np.bool_)
    held[LOG_SIZE] = True
    return held
