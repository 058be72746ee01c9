"""Errors of lengths: by fish, of intervals, and of distributions (paper, Sec. 3 and Table 1)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field
from scipy.special import rel_entr

from stream_dmr.settings import Settings


class EvaluateSettings(Settings):
    """`[evaluate]`: how distributions of lengths are compared.

    The paper uses 500 to 1000 mm and does not state its bin width; 50 mm is this project's choice.
    """

    first_bin_mm: float = Field(
        default=500.0,
        ge=0,
        description="lower end of the histograms, shorter fish are left out, mm",
    )
    bin_width_mm: float = Field(default=50.0, gt=0, description="width of a bin, mm")
    num_bins: int = Field(
        default=10, ge=1, le=10000, description="number of bins; longer fish are left out"
    )
    pseudo_count: float = Field(
        default=0.5, gt=0, description="fish added to every bin for KL, so that none is empty"
    )

    def edges_mm(self) -> Float[np.ndarray, "E"]:
        """Edges of the bins: 500, 550, ..., 1000 mm by default."""
        return self.first_bin_mm + self.bin_width_mm * np.arange(self.num_bins + 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Histogram:
    """Numbers of fish in bins of length."""

    edges_mm: Float[np.ndarray, "E"]  # rising
    counts: Float[np.ndarray, "B"]  # fish in each bin; not all zero

    @property
    def centers_mm(self) -> Float[np.ndarray, "B"]:
        return (self.edges_mm[:-1] + self.edges_mm[1:]) / 2

    @property
    def shares(self) -> Float[np.ndarray, "B"]:
        """Normalised heights: the fraction of all kept fish in each bin."""
        return self.counts / self.counts.sum()


def length_histogram(
    lengths_mm: Float[np.ndarray, "N"], edges_mm: Float[np.ndarray, "E"]
) -> Histogram | None:
    """Histogram of the lengths within the edges, both ends included; None if there are none."""
    counts, _ = np.histogram(lengths_mm, bins=edges_mm)
    if counts.sum() == 0:
        return None
    return Histogram(edges_mm=edges_mm, counts=counts.astype(np.float64))


def histogram_bias_mm(predicted: Histogram, truth: Histogram) -> float:
    """Mean of the predicted distribution minus mean of the true distribution, in mm."""
    return float(truth.centers_mm @ (predicted.shares - truth.shares))


def histogram_emd_mm(predicted: Histogram, truth: Histogram) -> float:
    """Earth mover's distance in mm: how far, on average, a fish must move (Wasserstein-1)."""
    from scipy.stats import wasserstein_distance  # its import takes half a second

    return float(
        wasserstein_distance(predicted.centers_mm, truth.centers_mm, predicted.shares, truth.shares)
    )


def histogram_rmsd(predicted: Histogram, truth: Histogram) -> float:
    """Root mean square difference of the bins' shares, a fraction (the paper prints percent)."""
    return float(np.sqrt(np.mean((predicted.shares - truth.shares) ** 2)))


def histogram_kl(predicted: Histogram, truth: Histogram, *, pseudo_count: float) -> float:
    """Kullback-Leibler divergence of the predicted from the true distribution, in nats.

    sum_b t_b log(t_b / p_b). An empty bin would make it infinite, so `pseudo_count` fish are added
    to every bin of both beforehand (1/2: Krichevsky and Trofimov, 1981).
    """
    t, p = (h.counts + pseudo_count for h in (truth, predicted))
    return float(rel_entr(t / t.sum(), p / p.sum()).sum())


@dataclass(frozen=True, kw_only=True)
class DistributionErrors:
    """Table 1 of the paper: the difference between two length distributions."""

    bias_mm: float
    emd_mm: float
    rmsd: float  # fraction
    kl: float  # nats


def distribution_errors(
    predicted: Histogram, truth: Histogram, settings: EvaluateSettings
) -> DistributionErrors:
    return DistributionErrors(
        bias_mm=histogram_bias_mm(predicted, truth),
        emd_mm=histogram_emd_mm(predicted, truth),
        rmsd=histogram_rmsd(predicted, truth),
        kl=histogram_kl(predicted, truth, pseudo_count=settings.pseudo_count),
    )


@dataclass(frozen=True, kw_only=True)
class FishErrors:
    """Errors of measured fish against their own true lengths; percentages are of the truth."""

    mean_absolute_mm: float
    median_absolute_mm: float
    p90_absolute_mm: float
    bias_mm: float
    mean_absolute_percent: float
    median_absolute_percent: float
    p90_absolute_percent: float
    bias_percent: float


def fish_errors(
    predicted_mm: Float[np.ndarray, "N"], truth_mm: Float[np.ndarray, "N"]
) -> FishErrors | None:
    """Errors of paired lengths; None if there are none. p90 interpolates linearly."""
    if len(truth_mm) == 0:
        return None
    error_mm = predicted_mm - truth_mm
    percent = 100 * error_mm / truth_mm
    return FishErrors(
        mean_absolute_mm=float(np.mean(np.abs(error_mm))),
        median_absolute_mm=float(np.median(np.abs(error_mm))),
        p90_absolute_mm=float(np.percentile(np.abs(error_mm), 90)),
        bias_mm=float(np.mean(error_mm)),
        mean_absolute_percent=float(np.mean(np.abs(percent))),
        median_absolute_percent=float(np.median(np.abs(percent))),
        p90_absolute_percent=float(np.percentile(np.abs(percent), 90)),
        bias_percent=float(np.mean(percent)),
    )


def is_covered(
    truth_mm: Float[np.ndarray, "N"], intervals_mm: Float[np.ndarray, "N 2"]
) -> Bool[np.ndarray, "N"]:
    """True for each interval, both ends included, that contains its true length."""
    return (intervals_mm[:, 0] <= truth_mm) & (truth_mm <= intervals_mm[:, 1])


@dataclass(frozen=True, kw_only=True)
class IntervalFigures:
    """How well 95 % intervals are calibrated, over fish of known length."""

    coverage: float  # fraction of the intervals that contain the truth; 0.95 is right
    mean_width: float  # of the intervals, as a fraction of the true length
    nees: float | None  # mean of (error / std)^2; 1 is right; None: no stds


def interval_figures(
    *,
    predicted_mm: Float[np.ndarray, "N"],
    truth_mm: Float[np.ndarray, "N"],
    intervals_mm: Float[np.ndarray, "N 2"],
    stds_mm: Float[np.ndarray, "N"] | None,
) -> IntervalFigures | None:
    """Coverage, mean width and normalised estimation error squared; None if there are no fish.

    NEES after Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and
    navigation", 2001, Sec. 5.4: above 1 the stds are too small, below 1 too large.
    """
    if len(truth_mm) == 0:
        return None
    widths_mm = intervals_mm[:, 1] - intervals_mm[:, 0]
    error_mm = predicted_mm - truth_mm
    return IntervalFigures(
        coverage=float(np.mean(is_covered(truth_mm, intervals_mm))),
        mean_width=float(np.mean(widths_mm / truth_mm)),
        nees=None if stds_mm is None else float(np.mean((error_mm / stds_mm) ** 2)),
    )
