"""The Kalman filter of a constant length, with a robust start and a gate around that start.

x = [length_mm], F = H = 1, Q the square of a small drift, R from the std of each frame's fit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from filterpy.kalman import predict, rts_smoother, update
from jaxtyping import Float
from pydantic import Field

from stream_dmr.settings import Settings

_ONE = np.eye(1)
_STD_PER_MAD = 1 / NormalDist().inv_cdf(0.75)  # 1.48, of normal errors


class SmoothLengthSettings(Settings):
    """`[smooth_length]`: from the lengths of frames to the length of a fish."""

    min_frames: int = Field(default=3, ge=1, description="fewest good frames that give a length")
    max_std_ratio: float = Field(
        default=0.17, gt=0, description="largest std of a length that is given, over length"
    )
    max_frames: int = Field(default=2000, ge=1, description="most frames of one fish that are used")
    track_timeout_s: float = Field(
        default=10.0,
        gt=0,
        description="a fish of given boxes or masks ends when unseen for so long, s of capture "
        "time; a tracked one when the tracker drops it",
    )
    process_std_mm: float = Field(
        default=0.1, ge=0, description="drift of the measured length from frame to frame, std, mm"
    )
    gate_probability: float = Field(
        default=0.99, gt=0, lt=1, description="share of sound frames that pass the outlier gate"
    )
    min_frame_std_ratio: float = Field(
        default=0.005, gt=0, description="smallest std that a frame is given, over length"
    )
    frame_correlation: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="correlation of the errors of a fish's frames at any distance in time, 0 to 1",
    )
    correlation_time_s: float = Field(
        default=0.2,
        gt=0,
        description="time constant in which the rest of the correlation decays, s of capture time",
    )
    common_std_ratio: float = Field(
        default=0.01,
        ge=0,
        description="error that all frames of a fish share beside shape and plane, std over length",
    )
    std_factor: float = Field(
        default=0.85,
        gt=0,
        description="factor of the sum of all these stds: the parts overlap, so that without it "
        "stds of simulated fish that hang were 1.2 to 1.7 times too large",
    )
    upward_share: float = Field(
        default=0.62,
        gt=0,
        lt=1,
        description="share of a 95 % interval above its length: a slant that nobody sees makes a "
        "fish longer than it looks, never shorter",
    )


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """The length of one good frame."""

    frame_index: int
    timestamp_ns: int
    length_mm: float
    std_ratio: float  # std over length
    shared_std_ratio: float = 0.0  # of an error that all frames of the fish share


@dataclass(frozen=True, kw_only=True)
class RobustStart:
    """The start of a track's filter, by the majority of its frames instead of the first frame."""

    length_mm: float  # weighted median
    variance: float  # of that median, mm^2
    inflation: float  # at least 1: how much more the frames scatter than their fits promise

    def measurement_variance(self, measurement: Measurement) -> float:
        """R in mm^2.

        The std ratio is taken of the common length, not of the frame's own: else whatever reads
        short would also weigh more, and the mean would lean towards short.
        """
        return (self.inflation * measurement.std_ratio * self.length_mm) ** 2


def gate_threshold(probability: float) -> float:
    """Quantile of chi-square with one degree of freedom, which is a normal squared."""
    return NormalDist().inv_cdf((1 + probability) / 2) ** 2


def weighted_median(values: Float[np.ndarray, "N"], weights: Float[np.ndarray, "N"]) -> float:
    """Lowest value m of `values` that minimises sum_i weights_i |values_i - m|."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, below[-1] / 2)])


def robust_start(measurements: Sequence[Measurement]) -> RobustStart:
    """Weighted median of the frames and the scatter around it, neither moved by a few outliers.

    The scatter is the median absolute residual in units of each frame's std, brought to a std
    (x 1.48). Above 1 the fits' stds are too small, and all of them are multiplied by it,
    after Birge's ratio (Phys. Rev. 40, 207, 1932), here in its robust form.
    """
    lengths = np.array([m.length_mm for m in measurements])
    ratios = np.array([m.std_ratio for m in measurements])
    median = weighted_median(lengths, 1 / ratios)
    residuals = np.abs(lengths - median) / (ratios * median)
    inflation = max(1.0, _STD_PER_MAD * float(np.median(residuals)))
    # A median is pi/2 times less certain than the mean of the same normal errors.
    variance = np.pi / 2 * (inflation * median) ** 2 / np.sum(ratios**-2.0)
    return RobustStart(length_mm=median, variance=float(variance), inflation=inflation)


class _ErrorCorrelation:
    """Correlation of the errors of frames: c + (1 - c) exp(-t / tau) for two a time t apart.

    A fish in one pose for a second is seen no better by sixty frames than by fifteen.
    """

    def __init__(self, lasting: float, correlation_time_s: float) -> None:
        self._lasting, self._tau_ns = lasting, correlation_time_s * 1e9
        self._count, self._last_ns = 0, 0
        self._with_earlier = 0.0  # of the last frame: sum of exp(-t / tau) over all before it
        self._pairs = 0.0  # the same over all pairs

    def add(self, timestamp_ns: int) -> None:
        fading = math.exp(-abs(timestamp_ns - self._last_ns) / self._tau_ns)
        self._with_earlier = fading * (self._with_earlier + 1.0) if self._count else 0.0
        self._pairs += self._with_earlier
        self._count, self._last_ns = self._count + 1, timestamp_ns

    @property
    def design_effect(self) -> float:
        """Variance of the frames' plain mean over that of as many independent ones (Kish)."""
        passing = 1.0 + 2.0 * self._pairs / max(self._count, 1)
        return self._lasting * self._count + (1.0 - self._lasting) * passing


class ConstantLengthFilter:
    """The filter along one track: state and variance after each frame that it used."""

    def __init__(self, start: RobustStart, settings: SmoothLengthSettings) -> None:
        self.frames: list[int] = []
        self._correlation = _ErrorCorrelation(
            settings.frame_correlation, settings.correlation_time_s
        )
        self._x: list[np.ndarray] = []
        self._P: list[np.ndarray] = []
        self._start = start
        self._process_variance = settings.process_std_mm**2
        self._gate = gate_threshold(settings.gate_probability)

    @property
    def length_mm(self) -> float:
        """After the last used frame."""
        return float(self._x[-1][0])

    @property
    def variance(self) -> float:
        """After the last used frame, mm^2, were the errors of frames independent."""
        return float(self._P[-1][0, 0])

    @property
    def design_effect(self) -> float:
        """How many times larger the variance is, since the errors of frames are correlated."""
        return self._correlation.design_effect

    def offer(self, measurement: Measurement) -> bool:
        """Use one more frame, in the order of frames, unless it contradicts most of the others.

        The gate is around the robust start, not around the frames used so far: a few wrong frames
        at the beginning, as of a track that began on another fish, would shut out all the others.
        """
        z = np.array([measurement.length_mm])
        R = _ONE * self._start.measurement_variance(measurement)
        # y^2 / S is chi-square with one degree of freedom
        y, S = z[0] - self._start.length_mm, R[0, 0] + self._start.variance
        if y**2 > self._gate * S:
            return False
        if self.frames:
            Q = self._process_variance * (measurement.frame_index - self.frames[-1])
            x, P = predict(self._x[-1], self._P[-1], Q=Q)  # pyright: ignore[reportArgumentType]
            x, P = update(x, P, z, R, _ONE)[:2]
        else:  # the start serves the gate only: the first frame used is the whole state (no prior)
            x, P = z, R
        self.frames.append(measurement.frame_index)
        self._correlation.add(measurement.timestamp_ns)
        self._x.append(x)
        self._P.append(P)
        return True

    def smoothed(self) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """Length in mm and variance in mm^2 at each used frame, given all of them (RTS)."""
        if not self.frames:
            return np.zeros(0), np.zeros(0)
        gaps = np.append(np.diff(self.frames), 1)  # rts_smoother ignores the last
        Qs = self._process_variance * gaps[:, None, None] * _ONE
        x, P, _, _ = rts_smoother(
            np.array(self._x), np.array(self._P), [_ONE] * len(gaps), list(Qs)
        )
        return x[:, 0], P[:, 0, 0]


def run_filter(
    measurements: Sequence[Measurement], settings: SmoothLengthSettings
) -> ConstantLengthFilter:
    """Filter a whole track, from its robust start."""
    track = ConstantLengthFilter(robust_start(measurements), settings)
    for measurement in measurements:
        track.offer(measurement)
    return track
