"""How good lengths are: fish by fish, and as a distribution (paper, Sec. 3 and Table 1)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import entropy, wasserstein_distance


@dataclass(frozen=True, eq=False, kw_only=True)
class Histogram:
    """Shares of fish in bins of equal width; they sum to 1."""

    centers_mm: Float[np.ndarray, "B"]  # middle of each bin
    counts: Float[np.ndarray, "B"]  # fish in each bin

    @property
    def shares(self) -> Float[np.ndarray, "B"]:
        """Normalised heights: the fraction of all kept fish in each bin."""
        return self.counts / self.counts.sum()


def length_histogram(
    lengths_mm: Float[np.ndarray, "N"],
    *,
    bin_width_mm: float = 50.0,
    kept_mm: tuple[float, float] = (500.0, 1000.0),
) -> Histogram | None:
    """Histogram of the lengths within `kept_mm`, both ends included; None where there are none.

    The paper keeps 500 to 1000 mm and does not state its bin width; 50 mm is ours.
    Raises ValueError where the bins don't fill the kept range.
    """
    low, high = kept_mm
    num_bins = round((high - low) / bin_width_mm)
    if num_bins < 1 or not np.isclose(num_bins * bin_width_mm, high - low):
        raise ValueError(f"expected bins that fill {low} to {high} mm, got {bin_width_mm} mm wide")
    counts, edges_mm = np.histogram(lengths_mm, bins=num_bins, range=kept_mm)
    if counts.sum() == 0:
        return None
    centers_mm = (edges_mm[:-1] + edges_mm[1:]) / 2
    return Histogram(centers_mm=centers_mm, counts=counts.astype(np.float64))


def histogram_bias_mm(predicted: Histogram, truth: Histogram) -> float:
    """Mean of the predicted distribution minus the mean of the true one, in mm."""
    return float(truth.centers_mm @ (predicted.shares - truth.shares))


def histogram_emd_mm(predicted: Histogram, truth: Histogram) -> float:
    """Earth mover's distance in mm: how far, on average, a fish must move (Wasserstein-1)."""
    return float(
        wasserstein_distance(predicted.centers_mm, truth.centers_mm, predicted.shares, truth.shares)
    )


def histogram_rmsd(predicted: Histogram, truth: Histogram) -> float:
    """Root mean square difference of the bins' shares, a fraction (the paper prints percent)."""
    return float(np.sqrt(np.mean((predicted.shares - truth.shares) ** 2)))


def histogram_kl(predicted: Histogram, truth: Histogram, *, pseudo_count: float = 0.5) -> float:
    """Kullback-Leibler divergence of the predicted distribution from the true one, in nats.

    sum_b t_b log(t_b / p_b). An empty bin would make it infinite, so `pseudo_count` fish are added
    to every bin of both beforehand (1/2: Krichevsky and Trofimov, 1981).
    """
    # entropy(p, q) normalises both
    return float(entropy(truth.counts + pseudo_count, predicted.counts + pseudo_count))


@dataclass(frozen=True, kw_only=True)
class DistributionErrors:
    """Table 1 of the paper: the difference between two length distributions."""

    bias_mm: float
    emd_mm: float
    rmsd: float  # fraction
    kl: float  # nats


def distribution_errors(
    predicted_mm: Float[np.ndarray, "P"], truth_mm: Float[np.ndarray, "T"]
) -> DistributionErrors | None:
    """Compare two sets of lengths without pairing them; None where one has no fish in range."""
    predicted, truth = length_histogram(predicted_mm), length_histogram(truth_mm)
    if predicted is None or truth is None:
        return None
    return DistributionErrors(
        bias_mm=histogram_bias_mm(predicted, truth),
        emd_mm=histogram_emd_mm(predicted, truth),
        rmsd=histogram_rmsd(predicted, truth),
        kl=histogram_kl(predicted, truth),
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
    """Errors of paired lengths; None where there are none. p90 interpolates linearly."""
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
    """Whether each interval, both ends included, holds its true length."""
    return (intervals_mm[:, 0] <= truth_mm) & (truth_mm <= intervals_mm[:, 1])
