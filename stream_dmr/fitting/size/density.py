"""Density of a fish's size from the sizes that were tried, and its moments: compiled loops."""

import numpy as np
from jaxtyping import Float

from stream_dmr.compiled import compiled

_STEP = 0.002  # of the integration over log sizes
_BEYOND = 0.15  # how far it goes past the sizes tried
_STEEPEST_END = 10.0  # nats per unit of log size: past the ends sizes get at least so unlikely


@compiled
def mean_and_std(
    offsets: Float[np.ndarray, "G"], nats: Float[np.ndarray, "G"]
) -> tuple[float, float]:
    """Of the density exp(-nats) over log sizes, which between those tried is a smooth curve.

    `offsets` ascend. Past them the curve goes on straight, and steeply enough.
    """
    last = len(offsets) - 1
    slopes = pchip_slopes(offsets, nats)
    falling = rising = _STEEPEST_END
    if last > 0:
        falling = max(-(nats[1] - nats[0]) / (offsets[1] - offsets[0]), falling)
        rising = max((nats[last] - nats[last - 1]) / (offsets[last] - offsets[last - 1]), rising)
    count = int(np.ceil((offsets[last] - offsets[0] + 2 * _BEYOND) / _STEP))
    likeliest = nats[0]
    for one in nats:
        likeliest = min(likeliest, one)
    total = first = second = 0.0
    k = 0
    for n in range(count):
        x = offsets[0] - _BEYOND + n * _STEP
        inside = min(max(x, offsets[0]), offsets[last])
        while k < last - 1 and inside > offsets[k + 1]:
            k += 1
        value = _hermite(offsets, nats, slopes, k, inside) if last > 0 else nats[0]
        value += (inside - x) * falling if x < inside else (x - inside) * rising
        density = np.exp(likeliest - value)
        total += density
        first += density * x
        second += density * x * x
    mean = first / total
    return mean, np.sqrt(max(second / total - mean * mean, 0.0))


@compiled
def pchip_slopes(x: Float[np.ndarray, "G"], y: Float[np.ndarray, "G"]) -> Float[np.ndarray, "G"]:
    """Slopes with which cubic pieces neither overshoot nor turn where the points do not.

    Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5, 300 (1984); the ends by three points. That
    of SciPy's PchipInterpolator, whose set-up alone would be a tenth of a warm fit.
    """
    last = len(x) - 1
    slopes = np.zeros(len(x))
    if last == 1:
        slopes[:] = (y[1] - y[0]) / (x[1] - x[0])
    if last < 2:
        return slopes
    for k in range(1, last):
        h0, h1 = x[k] - x[k - 1], x[k + 1] - x[k]
        d0, d1 = (y[k] - y[k - 1]) / h0, (y[k + 1] - y[k]) / h1
        if d0 * d1 > 0:
            w0, w1 = 2 * h1 + h0, h1 + 2 * h0
            slopes[k] = (w0 + w1) / (w0 / d0 + w1 / d1)
    slopes[0] = _end_slope(x, y, 0, 1)
    slopes[last] = _end_slope(x, y, last, -1)
    return slopes


@compiled
def _end_slope(
    x: Float[np.ndarray, "G"], y: Float[np.ndarray, "G"], end: int, inwards: int
) -> float:
    near, far = end + inwards, end + 2 * inwards
    h0, h1 = x[near] - x[end], x[far] - x[near]
    d0, d1 = (y[near] - y[end]) / h0, (y[far] - y[near]) / h1
    slope = ((2 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
    if slope * d0 <= 0:
        return 0.0
    if d0 * d1 < 0 and abs(slope) > 3 * abs(d0):
        return 3 * d0
    return slope


@compiled
def _hermite(
    x: Float[np.ndarray, "G"],
    y: Float[np.ndarray, "G"],
    slopes: Float[np.ndarray, "G"],
    k: int,
    at: float,
) -> float:
    """The cubic piece between the points k and k + 1."""
    h = x[k + 1] - x[k]
    t = (at - x[k]) / h
    s = 1.0 - t
    ends = y[k] * s * s * (1 + 2 * t) + y[k + 1] * t * t * (1 + 2 * s)
    return ends + h * t * s * (slopes[k] * s - slopes[k + 1] * t)
