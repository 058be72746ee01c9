"""How well each size of the fish explains its mask, when all else may follow: compiled loops."""

import numpy as np

from stream_dmr.compiled import compiled
from stream_dmr.fitting.contour.levenberg_marquardt import (
    NEAR,
    factorise,
    minimise,
    solve_factorised,
)

SIZE = 5  # the root's log scale, of the parameters


@compiled
def scan_sizes(
    body, kind, target, lambdas, priors, start, rest, offsets, hopeless, iterations, tolerance
):
    """Fit anew at each log size `start[SIZE] + offsets` (ascending, 0 among them).

    From the start outwards, each size from where its neighbour's fit is headed, and no further than
    sizes whose loss is worse than the start's by `hopeless`. Returns the fits (G, P), their losses
    (G,), infinite where not tried, half the log determinants of the loss's curvature in all but the
    size (G,), and the slopes of the fits to the log size (G, P).
    """
    count, middle = len(offsets), np.argmin(np.abs(offsets))
    fits, leads = np.zeros((count, len(start))), np.zeros((count, len(start)))
    losses, rooms = np.full(count, np.inf), np.zeros(count)
    fits[middle], losses[middle], rooms[middle], leads[middle] = _fit_of_this_size(
        body, kind, target, lambdas, priors, start, rest, iterations, tolerance
    )
    for way in (1, -1):
        n = middle + way
        while 0 <= n < count and losses[n - way] < losses[middle] + hopeless:
            guess = fits[n - way] + (offsets[n] - offsets[n - way]) * leads[n - way]
            guess[SIZE] = start[SIZE] + offsets[n]
            fits[n], losses[n], rooms[n], leads[n] = _fit_of_this_size(
                body, kind, target, lambdas, priors, guess, rest, iterations, tolerance
            )
            n += way
    return fits, losses, rooms, leads


@compiled
def only_size(num_parameters):
    """The mask (P,) of parameters that holds the size alone."""
    held = np.zeros(num_parameters, np.bool_)
    held[SIZE] = True
    return held


@compiled
def _fit_of_this_size(body, kind, target, lambdas, priors, start, rest, iterations, tolerance):
    """The best fit (P,) of the start's size, its loss, half log determinant and slope (P,)."""
    held = only_size(len(start))
    found = minimise(
        body, kind, target, lambdas, priors, start, rest, held, iterations, tolerance, NEAR
    )
    L = factorise(found.H, 0.0, held)
    lead = solve_factorised(L, np.where(held, 0.0, -found.H[SIZE]))
    lead[SIZE] = 1.0
    return found.flat, found.loss, np.sum(np.log(np.diag(L))), lead
