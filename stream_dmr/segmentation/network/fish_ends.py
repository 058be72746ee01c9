"""Head and tail of a fish from the network's two maps."""

import math
from itertools import permutations

import numpy as np
from jaxtyping import Float, Float32

from stream_dmr.messages import FishEnds
from stream_dmr.segmentation.network.unet_interface import ENDS_STRIDE

_MIN_DISTANCE = 3.0  # cells between head and tail: three of the training target's spreads
_NEAR = 2  # rows and columns: of the cells this near all are nearer than that
_PEAK_RADIUS = 2  # cells around a peak whose mean locates it between the cells
_MAX_LOG_ODDS = 50.0  # keeps the exponential finite; the confidence is 1 long before


def find_ends(maps: Float32[np.ndarray, "2 s s"]) -> FishEnds:
    """The most probable pair of head and tail, in pixels of the picture that the network saw.

    `maps` are log probabilities of head and tail per cell. The odds against the two being swapped
    are p_h(H) p_t(T) / (p_h(T) p_t(H)).
    """
    cells = [cell for one in maps for cell in _peaks(one)]
    value, head, tail = max(
        (float(maps[0][h] + maps[1][t]), h, t)
        for h, t in permutations(cells, 2)
        if math.dist(h, t) >= _MIN_DISTANCE
    )
    log_odds = min(value - float(maps[0][tail] + maps[1][head]), _MAX_LOG_ODDS)
    cells_xy = np.array([_refine(maps[0], head), _refine(maps[1], tail)])
    head_px, tail_px = (cells_xy + 0.5) * ENDS_STRIDE - 0.5
    confidence = 1 / (1 + math.exp(-log_odds))
    return FishEnds(head_px=head_px, tail_px=tail_px, confidence=confidence)


def _peaks(log_probability: Float32[np.ndarray, "s s"]) -> list[tuple[int, int]]:
    """Row and column of the highest cell, and of the highest one away from it."""
    row, column = divmod(int(log_probability.argmax()), len(log_probability))
    away = log_probability.copy()
    away[
        max(0, row - _NEAR) : row + _NEAR + 1, max(0, column - _NEAR) : column + _NEAR + 1
    ] = -np.inf
    return [(row, column), divmod(int(away.argmax()), len(away))]


def _refine(
    log_probability: Float32[np.ndarray, "s s"], cell: tuple[int, int]
) -> Float[np.ndarray, "2"]:
    """Column and row of a peak between the cells: the mean of those around it."""
    row, column = cell
    top, left = max(0, row - _PEAK_RADIUS), max(0, column - _PEAK_RADIUS)
    around = log_probability[top : row + _PEAK_RADIUS + 1, left : column + _PEAK_RADIUS + 1]
    weights = np.exp((around - around.max()).astype(np.float64))
    rows, columns = np.indices(weights.shape)
    total = weights.sum()
    return np.array(
        [left + (columns * weights).sum() / total, top + (rows * weights).sum() / total]
    )
