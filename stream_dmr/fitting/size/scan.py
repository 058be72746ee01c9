"""How well each size of the fish explains its mask, when all else may follow: compiled loops."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.levenberg_marquardt import factorise, minimise, solve_factorised
from stream_dmr.fitting.contour.problem import Options, Problem
from stream_dmr.fitting.parameters import LOG_SIZE


class SizeFit(NamedTuple):
    """The best fit of one size."""

    parameters: Float[np.ndarray, "P"]
    loss: float
    log_volume: float  # half the log determinant of the loss's curvature in all but the size
    next_step: Float[np.ndarray, "P"]  # slope of the best fit to the log size


class SizeScan(NamedTuple):
    """The best fits of G sizes."""

    parameters: Float[np.ndarray, "G P"]
    losses: Float[np.ndarray, "G"]  # infinite where not tried
    log_volumes: Float[np.ndarray, "G"]
    next_steps: Float[np.ndarray, "G P"]


@compiled
def scan_sizes(
    problem: Problem,
    start: Float[np.ndarray, "P"],
    offsets: Float[np.ndarray, "G"],
    max_excess: float,
    options: Options,
) -> SizeScan:
    """Refit at each log size `start[LOG_SIZE] + offsets` (ascending, 0 among them).

    From the start outwards, each size from where its neighbour's fit is headed, and no further than
    sizes whose loss exceeds the start's by `max_excess`.
    """
    count, middle = len(offsets), np.argmin(np.abs(offsets))
    fits, next_steps = np.zeros((count, len(start))), np.zeros((count, len(start)))
    losses, log_volumes = np.full(count, np.inf), np.zeros(count)
    fits[middle], losses[middle], log_volumes[middle], next_steps[middle] = fit_at_size(
        problem, start, options
    )
    for step in (1, -1):
        n = middle + step
        while 0 <= n < count and losses[n - step] < losses[middle] + max_excess:
            guess = fits[n - step] + (offsets[n] - offsets[n - step]) * next_steps[n - step]
            guess[LOG_SIZE] = start[LOG_SIZE] + offsets[n]
            fits[n], losses[n], log_volumes[n], next_steps[n] = fit_at_size(problem, guess, options)
            n += step
    return SizeScan(fits, losses, log_volumes, next_steps)


@compiled
def only_size(num_parameters: int) -> Bool[np.ndarray, "P"]:
    """The mask of parameters that holds the size alone."""
    held = np.zeros(num_parameters, np.bool_)
    held[LOG_SIZE] = True
    return held


@compiled
def fit_at_size(problem: Problem, start: Float[np.ndarray, "P"], options: Options) -> SizeFit:
    """The best fit of the start's size."""
    held = only_size(len(start))
    found = minimise(problem, start, held, options)
    L = factorise(found.H, 0.0, held)
    next_step = solve_factorised(L, np.where(held, 0.0, -found.H[LOG_SIZE]))
    next_step[LOG_SIZE] = 1.0
    return SizeFit(found.parameters, found.loss, np.sum(np.log(np.diag(L))), next_step)
