"""`stream-dmr evaluate`: measured against true lengths, by fish and as distributions.

Fish are paired by track_id; the two distributions are compared without pairing, as in the paper.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from stream_dmr.errors import OutputError, UserError, reason_of, requires_extra
from stream_dmr.evaluation.length_errors import (
    DistributionErrors,
    EvaluateSettings,
    FishErrors,
    Histogram,
    IntervalFigures,
    distribution_errors,
    fish_errors,
    interval_figures,
    length_histogram,
)
from stream_dmr.evaluation.length_tables import (
    Interval,
    LengthRow,
    read_histogram,
    read_lengths,
    read_truth,
)


@dataclass(frozen=True, kw_only=True)
class FishComparison:
    """The true and the measured length of one fish."""

    track_id: int
    truth_mm: float
    length_mm: float | None  # None: not measured
    std_mm: float | None
    ci95_mm: Interval | None

    @property
    def error_mm(self) -> float | None:
        """Measured minus true."""
        return None if self.length_mm is None else self.length_mm - self.truth_mm


@dataclass(frozen=True, kw_only=True)
class Distributions:
    """Two histograms with the same bins, and their differences."""

    predicted: Histogram
    truth: Histogram
    errors: DistributionErrors
    num_outside: int  # measured fish shorter or longer than all bins


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """How a table of lengths compares with the truth."""

    fish: tuple[FishComparison, ...]  # every fish of the truth, in its order
    unmeasured: tuple[int, ...]  # ids with a row but no length
    missing: tuple[int, ...]  # ids of the truth without a row
    unknown: tuple[int, ...]  # ids with a row but no truth; only in `distributions`
    fraction_measured: float  # of the fish of the truth
    intervals: IntervalFigures | None  # None: no intervals
    errors: FishErrors | None  # None: nothing measured
    distributions: Distributions | None  # None: no fish within the bins

    @property
    def coverage(self) -> float | None:
        """Fraction of the 95 % intervals that hold the truth; None: no intervals."""
        return None if self.intervals is None else self.intervals.coverage


_DEFAULTS = EvaluateSettings()


def evaluate(
    lengths_csv: Path, truth_csv: Path, *, settings: EvaluateSettings = _DEFAULTS
) -> Evaluation:
    """Compare two CSV files fish by fish.

    Raises UserError if one can't be read, or if they have no track_id in common, by which fish are
    paired.
    """
    lengths, truth = read_lengths(lengths_csv), read_truth(truth_csv)
    if lengths and not lengths.keys() & truth.keys():
        raise UserError(
            f"{lengths_csv}: expected fish by the track_ids of {truth_csv} ({_some(truth)}), got "
            f"others ({_some(lengths)}); use the same track_ids, or give a histogram as the truth"
        )
    return compare(lengths, truth, settings=settings)


_UNITS_MM = {"cm": 10.0, "inches": 25.4, "m": 1000.0}
_NEAR_UNIT = 1.2  # no fish is measured wrong by eight times; chosen


def unit_of_truth(evaluation: Evaluation) -> str | None:
    """The unit in which the truth seems to be by what was measured; None: mm, or nothing known."""
    ratios = [fish.length_mm / fish.truth_mm for fish in evaluation.fish if fish.length_mm]
    ratio = float(np.median(ratios)) if ratios else 1.0
    near = [unit for unit, mm in _UNITS_MM.items() if 1 / _NEAR_UNIT < ratio / mm < _NEAR_UNIT]
    return near[0] if near else None


def _some(ids: Iterable[int], most: int = 5) -> str:
    first = [str(i) for i in ids]
    return ", ".join(first[:most]) + (", ..." if len(first) > most else "")


def evaluate_histogram(
    lengths_csv: Path, histogram_csv: Path, *, settings: EvaluateSettings = _DEFAULTS
) -> Distributions:
    """Compare lengths with a histogram, in its own bins.

    Only the pseudo count of the settings is used. A histogram of shares is scaled to the number of
    measured fish. Raises UserError if a file can't be read or no fish lies in the bins.
    """
    known = read_histogram(histogram_csv)
    lengths_mm = _measured_mm(read_lengths(lengths_csv))
    predicted = length_histogram(lengths_mm, known.histogram.edges_mm)
    if predicted is None:
        low, high = known.histogram.edges_mm[[0, -1]]
        got = f"{lengths_mm.min():.0f} to {lengths_mm.max():.0f} mm" if lengths_mm.size else "none"
        raise UserError(
            f"{lengths_csv}: expected lengths from {low:g} to {high:g} mm, got {got}; check that "
            f"the bins of {histogram_csv} are in mm"
        )
    truth = known.histogram
    if known.is_shares:
        truth = Histogram(edges_mm=truth.edges_mm, counts=truth.shares * predicted.counts.sum())
    return _distributions(lengths_mm, predicted, truth, settings)


def compare(
    lengths: Mapping[int, LengthRow], truth: Mapping[int, float], *, settings: EvaluateSettings
) -> Evaluation:
    """Compare measured with true lengths (mm), both by track_id; at least one true length."""
    nothing = LengthRow(length_mm=None)
    fish = tuple(
        FishComparison(
            track_id=track_id,
            truth_mm=truth_mm,
            length_mm=lengths.get(track_id, nothing).length_mm,
            std_mm=lengths.get(track_id, nothing).std_mm,
            ci95_mm=lengths.get(track_id, nothing).ci95_mm,
        )
        for track_id, truth_mm in truth.items()
    )
    pairs = [(f.length_mm, f.truth_mm) for f in fish if f.length_mm is not None]
    paired_mm, paired_truth_mm = np.array(pairs).reshape(-1, 2).T
    return Evaluation(
        fish=fish,
        unmeasured=tuple(i for i in truth if i in lengths and lengths[i].length_mm is None),
        missing=tuple(i for i in truth if i not in lengths),
        unknown=tuple(i for i in lengths if i not in truth),
        fraction_measured=len(pairs) / len(fish),
        intervals=_intervals(fish),
        errors=fish_errors(paired_mm, paired_truth_mm),
        distributions=_compare_distributions(
            _measured_mm(lengths), np.array(list(truth.values())), settings
        ),
    )


def _measured_mm(lengths: Mapping[int, LengthRow]) -> Float[np.ndarray, "N"]:
    return np.array([row.length_mm for row in lengths.values() if row.length_mm is not None])


def _compare_distributions(
    lengths_mm: Float[np.ndarray, "P"], truth_mm: Float[np.ndarray, "T"], settings: EvaluateSettings
) -> Distributions | None:
    edges_mm = settings.edges_mm()
    predicted, truth = (length_histogram(mm, edges_mm) for mm in (lengths_mm, truth_mm))
    if predicted is None or truth is None:
        return None
    return _distributions(lengths_mm, predicted, truth, settings)


def _distributions(
    lengths_mm: Float[np.ndarray, "P"],
    predicted: Histogram,
    truth: Histogram,
    settings: EvaluateSettings,
) -> Distributions:
    return Distributions(
        predicted=predicted,
        truth=truth,
        errors=distribution_errors(predicted, truth, settings),
        num_outside=len(lengths_mm) - round(predicted.counts.sum()),
    )


def _intervals(fish: tuple[FishComparison, ...]) -> IntervalFigures | None:
    """Figures over the fish that have an interval; NEES only if all of them have a std."""
    known = [f for f in fish if f.length_mm is not None and f.ci95_mm is not None]
    stds_mm = [f.std_mm for f in known if f.std_mm is not None]
    return interval_figures(
        predicted_mm=np.array([f.length_mm for f in known], np.float64),
        truth_mm=np.array([f.truth_mm for f in known]),
        intervals_mm=np.array([f.ci95_mm for f in known]).reshape(-1, 2),
        stds_mm=np.array(stds_mm) if len(stds_mm) == len(known) else None,
    )


def summary_rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Name and value of each figure, for a table of two columns."""
    num_measured = sum(f.length_mm is not None for f in evaluation.fish)
    rows = [("fish measured", f"{num_measured} of {len(evaluation.fish)}")]
    for name, ids in (
        ("not measured, track", evaluation.unmeasured),
        ("not in the lengths, track", evaluation.missing),
        ("not in the truth, track", evaluation.unknown),
    ):
        if ids:
            rows.append((name, ", ".join(map(str, ids))))
    if evaluation.errors is not None:
        rows += _error_rows(evaluation.errors)
    if evaluation.intervals is not None:
        rows += _interval_rows(evaluation.intervals)
    if evaluation.distributions is not None:
        rows += distribution_rows(evaluation.distributions)
    return rows


def distribution_rows(distributions: Distributions) -> list[tuple[str, str]]:
    """Name and value of each figure of Table 1."""
    d = distributions.errors
    rows = [
        ("distribution: bias", f"{d.bias_mm:+.1f} mm"),
        ("distribution: EMD", f"{d.emd_mm:.1f} mm"),
        ("distribution: RMSD", f"{100 * d.rmsd:.1f} %"),
        ("distribution: KL", f"{d.kl:.2f}"),
    ]
    if distributions.num_outside:
        low, high = distributions.truth.edges_mm[[0, -1]]
        outside = f"{distributions.num_outside} outside {low:g} to {high:g} mm"
        rows.append(("distribution: left out", outside))
    return rows


def _error_rows(e: FishErrors) -> list[tuple[str, str]]:
    median = f"{e.median_absolute_mm:.1f} mm, {e.median_absolute_percent:.2f} %"
    return [
        ("mean absolute error", f"{e.mean_absolute_mm:.1f} mm, {e.mean_absolute_percent:.2f} %"),
        ("median absolute error", median),
        ("90th percentile", f"{e.p90_absolute_mm:.1f} mm, {e.p90_absolute_percent:.2f} %"),
        ("bias", f"{e.bias_mm:+.1f} mm, {e.bias_percent:+.2f} %"),
    ]


def _interval_rows(i: IntervalFigures) -> list[tuple[str, str]]:
    rows = [
        ("truth within the 95 % interval", f"{100 * i.coverage:.0f} %"),
        ("its mean width", f"{100 * i.mean_width:.1f} % of the length"),
    ]
    if i.nees is not None:
        rows.append(("NEES (1 is right)", f"{i.nees:.2f}"))
    return rows


def plot_histograms(path: Path, distributions: Distributions) -> None:
    """Draw both histograms into a picture; the suffix of `path` is its format, PNG without one.

    Raises OutputError if it can't be written.
    """
    with requires_extra("plots", "a plot of the lengths"):
        from matplotlib.figure import Figure  # its import takes a quarter of a second

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    predicted, truth, errors = distributions.predicted, distributions.truth, distributions.errors
    axes.stairs(100 * truth.shares, truth.edges_mm, fill=True, color="0.8", label="true")
    axes.stairs(100 * predicted.shares, predicted.edges_mm, color="C0", lw=2, label="measured")
    axes.set(
        xlabel="length, mm",
        ylabel="fish, %",
        title=f"bias {errors.bias_mm:+.1f} mm, EMD {errors.emd_mm:.1f} mm, "
        f"RMSD {100 * errors.rmsd:.1f} %, KL {errors.kl:.2f}",
    )
    axes.legend(frameon=False)
    try:
        # A mark by which `evaluate` recognises its own pictures; other formats name it differently.
        made_by = {"Software": "stream-dmr evaluate"} if path.suffix in ("", ".png") else None
        figure.savefig(path, dpi=110, metadata=made_by)
    except (OSError, ValueError) as error:  # ValueError: a suffix that matplotlib doesn't know
        raise OutputError(
            f"{path}: expected to write a picture there, got: {reason_of(error)}"
        ) from error
