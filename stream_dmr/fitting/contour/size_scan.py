"""How well each size of the fish explains its mask, when all else may follow: compiled loops."""

import numpy as np

from stream_dmr.fitting.compiled import compiled
from stream_dmr.fitting.contour.levenberg_marquardt import (
    NEAR,
    evaluate,
    factorise,
    hold,
    minimise,
)
from stream_dmr.fitting.contour.normal_equations import normal_equations

SIZE = 5  # the root's log scale, of the parameters
# In L_rec: a fit that a neighbour's pose would better by so much has been left behind by it.
_LEFT_BEHIND = 0.003


@compiled
def scan_sizes(body, kind, target, lambdas, priors, start, rest, offsets, iterations, tolerance):
    """Fit anew at each log size `start[SIZE] + offsets` (ascending, 0 among them).

    Returns the fits (G, P), their losses (G,), and half the log determinant of the curvature of
    the loss in everything but the size (G,). From the start outwards, each size from its neighbour;
    then once more from the smallest to the largest, since a pose that is not found from above,
    with a fish too bent or too slanting, is found from below, where it must be flat.
    """
    count = len(offsets)
    held = only_size(len(start))
    fits, losses = np.empty((count, len(start))), np.empty(count)
    middle = np.argmin(np.abs(offsets))
    pose = start
    for way in range(2):
        for n in range(middle, count) if way == 0 else range(middle - 1, -1, -1):
            pose, losses[n] = _fit_at(
                start[SIZE] + offsets[n],
                body, kind, target, lambdas, priors, pose, rest, held, iterations, tolerance,
            )  # fmt: skip
            fits[n] = pose
        pose = fits[middle]
    pose = fits[0]
    for n in range(1, count):
        other, loss = _fit_at(
            start[SIZE] + offsets[n],
            body, kind, target, lambdas, priors, pose, rest, held, iterations, tolerance,
        )  # fmt: skip
        if loss < losses[n]:
            fits[n], losses[n] = other, loss
        pose = fits[n] if loss > losses[n] + _LEFT_BEHIND else other
    curvatures = np.empty(count)
    for n in range(count):
        curvatures[n] = _half_log_determinant(
            body, kind, target, lambdas, priors, fits[n], rest, held
        )
    return fits, losses, curvatures


@compiled
def only_size(num_parameters):
    """The mask (P,) of parameters that holds the size alone."""
    held = np.zeros(num_parameters, np.bool_)
    held[SIZE] = True
    return held


@compiled
def _fit_at(log_size, body, kind, target, lambdas, priors, pose, rest, held, iterations, tolerance):
    """The best fit of one size from a pose, and its loss."""
    start = pose.copy()
    start[SIZE] = log_size
    flat, loss, _, _, _ = minimise(
        body, kind, target, lambdas, priors, start, rest, held, iterations, tolerance, NEAR
    )
    return flat, loss


@compiled
def _half_log_determinant(body, kind, target, lambdas, priors, flat, rest, held):
    """Of the curvature in the parameters that aren't held."""
    _, _, points, pixels, rim, covered = evaluate(body, kind, target, flat)
    H, g = normal_equations(
        body, kind, target, lambdas, priors, flat, rest, points, pixels, rim, covered
    )
    hold(held, H, g)
    L = factorise(H, 0.0)
    total = 0.0
    for p in range(len(flat)):
        total += np.log(L[p, p])
    return total
