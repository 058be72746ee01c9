"""How well each size of the fish explains its mask, when all else may follow: compiled loops."""

import numpy as np

from stream_dmr.fitting.compiled import compiled
from stream_dmr.fitting.contour.levenberg_marquardt import (
    NEAR,
    evaluate,
    factorise,
    hold,
    minimise,
    solve_factorised,
)
from stream_dmr.fitting.contour.normal_equations import normal_equations

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
    flat, loss, _, _, _ = minimise(
        body, kind, target, lambdas, priors, start, rest, held, iterations, tolerance, NEAR
    )
    _, _, points, pixels, rim, covered = evaluate(body, kind, target, flat, False)
    H, g = normal_equations(
        body, kind, target, lambdas, priors, flat, rest, points, pixels, rim, covered
    )
    pull = H[SIZE].copy()  # on the others, when the size grows
    pull[SIZE] = 0.0
    hold(held, H, g)
    L = factorise(H, 0.0)
    lead = -solve_factorised(L, pull)
    lead[SIZE] = 1.0
    return flat, loss, np.sum(np.log(np.diag(L))), lead
