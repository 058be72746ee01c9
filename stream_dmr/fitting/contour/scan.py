"""How well each size of the fish explains its mask, when all else may follow: compiled loops."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.levenberg_marquardt import (
    Minimum,
    factorise,
    minimise,
    solve_factorised,
    without,
)
from stream_dmr.fitting.contour.problem import Options, Problem
from stream_dmr.fitting.parameters import LOG_SIZE

_ONE_SIZE = np.zeros(1)


class SizeScan(NamedTuple):
    """The best fits of G sizes."""

    parameters: Float[np.ndarray, "G P"]
    losses: Float[np.ndarray, "G"]  # infinite where not tried
    log_volumes: Float[np.ndarray, "G"]
    next_steps: Float[np.ndarray, "G P"]
    start: Minimum  # that of the start's own size


def descend(
    problem: Problem,
    start: Float[np.ndarray, "P"],
    held: Bool[np.ndarray, "P"],
    options: Options,
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

    From the start outwards, each size from where its neighbour's fit is headed, and no further than
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
    """True where there is an n-th size, and the one before it is likely enough."""
    return 0 <= n < len(losses) and losses[before] < limit


@compiled
def only_size(num_parameters: int) -> Bool[np.ndarray, "P"]:
    """The mask of parameters that holds the size alone."""
    held = np.zeros(num_parameters, np.bool_)
    held[LOG_SIZE] = True
    return held
