"""The exact signed distance map of a mask in two passes: compiled loops.

Felzenszwalb and Huttenlocher, "Distance transforms of sampled functions", 2012: along the columns
by counting, along the rows by the lower envelope of parabolas. Both sides of the edge are done in
one sweep, since within a row nothing beyond the ends of a pixel's own run can be nearer than these.
"""

import numpy as np
from jaxtyping import Bool, Float, Int32

from stream_dmr.compiled import compiled

_NONE = 1 << 20  # no edge in this column; its square is still exact


def signed_distance(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Distance in pixels to the mask's edge, negative inside: the map behind `boundary_loss`.

    The edge lies half a pixel from the centres of the pixels on its two sides. All is infinitely
    far from the edge of a mask that has none.
    """
    return _along_rows(mask, _along_columns(mask))


@compiled
def _along_columns(mask: Bool[np.ndarray, "H W"]) -> Int32[np.ndarray, "H W"]:
    """Distance of each pixel to the nearest one of the other side in its column."""
    height, width = mask.shape
    gap = np.full((height, width), _NONE, np.int32)
    for i in range(1, height):
        for k in range(width):
            gap[i, k] = gap[i - 1, k] + 1 if mask[i, k] == mask[i - 1, k] else 1
    below = np.full(width, _NONE, np.int32)
    for i in range(height - 2, -1, -1):
        for k in range(width):
            below[k] = below[k] + 1 if mask[i, k] == mask[i + 1, k] else 1
            gap[i, k] = min(gap[i, k], below[k])
    return gap


@compiled
def _along_rows(
    mask: Bool[np.ndarray, "H W"], gap: Int32[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W"]:
    height, width = mask.shape
    signed = np.empty((height, width))
    # The envelope: where its parabolas stand, their values at 0, and from where on each is lowest.
    places, starts, froms = np.empty(width), np.empty(width), np.empty(width)
    for i in range(height):
        first = 0
        while first < width:
            last = first
            while last + 1 < width and mask[i, last + 1] == mask[i, first]:
                last += 1
            sign = -1.0 if mask[i, first] else 1.0
            count = _envelope(gap[i], first, last, places, starts, froms)
            _fill(signed[i], first, last, sign, places, starts, froms, count)
            first = last + 1
    return signed


@compiled
def _envelope(
    gap: Int32[np.ndarray, "W"],
    first: int,
    last: int,
    places: Float[np.ndarray, "W"],
    starts: Float[np.ndarray, "W"],
    froms: Float[np.ndarray, "W"],
) -> int:
    """Parabolas of one run of pixels; those of its two neighbours stand on the ground."""
    count = 0
    for k in range(max(first - 1, 0), min(last + 2, len(gap))):
        is_own = first <= k <= last
        if is_own and gap[k] >= _NONE:
            continue
        place = float(k)
        start = place * place
        if is_own:
            start += float(gap[k]) ** 2
        since = -np.inf
        while count > 0:
            since = (start - starts[count - 1]) / (2.0 * (place - places[count - 1]))
            if since > froms[count - 1]:
                break
            count -= 1
            since = -np.inf
        places[count], starts[count], froms[count] = place, start, since
        count += 1
    return count


@compiled
def _fill(
    signed: Float[np.ndarray, "W"],
    first: int,
    last: int,
    sign: float,
    places: Float[np.ndarray, "W"],
    starts: Float[np.ndarray, "W"],
    froms: Float[np.ndarray, "W"],
    count: int,
) -> None:
    if count == 0:
        signed[first : last + 1] = sign * np.inf
        return
    lowest = 0
    for k in range(first, last + 1):
        while lowest + 1 < count and froms[lowest + 1] <= k:
            lowest += 1
        squared = k * (k - 2.0 * places[lowest]) + starts[lowest]
        signed[k] = sign * (np.sqrt(squared) - 0.5)
