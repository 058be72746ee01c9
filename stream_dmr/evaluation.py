"""`stream-dmr evaluate`: a table of lengths against the true ones, fish by fish.

Read: `lengths.csv` as `run` writes it (used: track_id, length_mm and, where there,
ci95_low_mm, ci95_high_mm) and a `truth.csv` with track_id, length_mm. Fish are paired by track_id;
the two distributions are compared without pairing, as in the paper.
"""

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stream_dmr.errors import UserError
from stream_dmr.metrics import (
    DistributionErrors,
    FishErrors,
    distribution_errors,
    fish_errors,
    is_covered,
)

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class FishComparison:
    """One fish of the truth beside what was measured of it."""

    track_id: int
    truth_mm: float
    length_mm: float | None  # None: not measured
    ci95_mm: Interval | None

    @property
    def error_mm(self) -> float | None:
        """Measured minus true."""
        return None if self.length_mm is None else self.length_mm - self.truth_mm


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """How a table of lengths compares with the truth."""

    fish: tuple[FishComparison, ...]  # every fish of the truth, in its order
    unmeasured: tuple[int, ...]  # ids with a row but no length
    missing: tuple[int, ...]  # ids of the truth without a row
    unknown: tuple[int, ...]  # ids with a row but no truth; only in `distribution`
    fraction_measured: float  # of the fish of the truth
    coverage: float | None  # fraction of 95 % intervals that hold the truth; None: no intervals
    errors: FishErrors | None  # None: nothing measured
    distribution: DistributionErrors | None  # None: no fish within the kept range


@dataclass(frozen=True, kw_only=True)
class _Row:
    length_mm: float | None
    ci95_mm: Interval | None = None


def evaluate(lengths_csv: Path, truth_csv: Path) -> Evaluation:
    """Compare two files. Raises UserError, in one line, for whatever can't be read."""
    lengths = _read_table(lengths_csv)
    return _compare(lengths, _read_truth(truth_csv))


def _compare(lengths: Mapping[int, _Row], truth: Mapping[int, float]) -> Evaluation:
    nothing = _Row(length_mm=None)
    fish = tuple(
        FishComparison(
            track_id=track_id,
            truth_mm=truth_mm,
            length_mm=lengths.get(track_id, nothing).length_mm,
            ci95_mm=lengths.get(track_id, nothing).ci95_mm,
        )
        for track_id, truth_mm in truth.items()
    )
    pairs = [(f.length_mm, f.truth_mm) for f in fish if f.length_mm is not None]
    paired_mm, paired_truth_mm = np.array(pairs).reshape(-1, 2).T
    all_mm = np.array([row.length_mm for row in lengths.values() if row.length_mm is not None])
    return Evaluation(
        fish=fish,
        unmeasured=tuple(i for i in truth if i in lengths and lengths[i].length_mm is None),
        missing=tuple(i for i in truth if i not in lengths),
        unknown=tuple(i for i in lengths if i not in truth),
        fraction_measured=len(pairs) / len(fish),
        coverage=_coverage(fish),
        errors=fish_errors(paired_mm, paired_truth_mm),
        distribution=distribution_errors(all_mm, np.array(list(truth.values()))),
    )


def _coverage(fish: tuple[FishComparison, ...]) -> float | None:
    known = [(f.truth_mm, f.ci95_mm) for f in fish if f.length_mm is not None and f.ci95_mm]
    if not known:
        return None
    truth_mm, intervals_mm = zip(*known, strict=True)
    return float(np.mean(is_covered(np.array(truth_mm), np.array(intervals_mm))))


def summary_rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Name and value of each figure, ready for a table of two columns."""
    e, d = evaluation.errors, evaluation.distribution
    num_measured = sum(f.length_mm is not None for f in evaluation.fish)
    rows = [("fish measured", f"{num_measured} of {len(evaluation.fish)}")]
    for name, ids in (
        ("not measured, track", evaluation.unmeasured),
        ("not in the lengths, track", evaluation.missing),
        ("not in the truth, track", evaluation.unknown),
    ):
        if ids:
            rows.append((name, ", ".join(map(str, ids))))
    if e:
        rows += [
            (
                "mean absolute error",
                f"{e.mean_absolute_mm:.1f} mm, {e.mean_absolute_percent:.2f} %",
            ),
            (
                "median absolute error",
                f"{e.median_absolute_mm:.1f} mm, {e.median_absolute_percent:.2f} %",
            ),
            ("90th percentile", f"{e.p90_absolute_mm:.1f} mm, {e.p90_absolute_percent:.2f} %"),
            ("bias", f"{e.bias_mm:+.1f} mm, {e.bias_percent:+.2f} %"),
        ]
    if evaluation.coverage is not None:
        rows.append(("truth within the 95 % interval", f"{100 * evaluation.coverage:.0f} %"))
    if d:
        rows += [
            ("distribution: bias", f"{d.bias_mm:+.1f} mm"),
            ("distribution: EMD", f"{d.emd_mm:.1f} mm"),
            ("distribution: RMSD", f"{100 * d.rmsd:.1f} %"),
            ("distribution: KL", f"{d.kl:.2f}"),
        ]
    return rows


def _read_truth(path: Path) -> dict[int, float]:
    """Length in mm by track_id; every fish must have one."""
    truth: dict[int, float] = {}
    for track_id, row in _read_table(path).items():
        if row.length_mm is None:
            raise UserError(f"{path}: expected a length for track {track_id}, got an empty field")
        truth[track_id] = row.length_mm
    if not truth:
        raise UserError(f"{path}: expected a row for each fish, got none")
    return truth


def _read_table(path: Path) -> dict[int, _Row]:
    """Rows by track_id, in the file's order."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, strict=True)
            _check_columns(path, reader.fieldnames or [])
            rows: dict[int, _Row] = {}
            for record in reader:
                where = f"{path}, line {reader.line_num}"
                track_id = _track_id(record, where)
                if track_id in rows:
                    raise UserError(f"{where}: expected one row a fish, got track {track_id} again")
                rows[track_id] = _row(record, where)
            return rows
    except OSError as problem:
        raise UserError(f"{path}: can't be read ({problem.strerror})") from problem
    except (UnicodeDecodeError, csv.Error) as problem:
        raise UserError(f"{path}: expected a CSV file in UTF-8 ({problem})") from problem


def _check_columns(path: Path, columns: Iterable[str]) -> None:
    missing = [name for name in ("track_id", "length_mm") if name not in columns]
    if missing:
        raise UserError(
            f"{path}: expected the columns track_id and length_mm, "
            f"got {', '.join(columns) or 'an empty file'}"
        )


def _row(record: Mapping[str, str | None], where: str) -> _Row:
    length_mm = _number(record, "length_mm", where)
    if length_mm is not None and length_mm <= 0:
        raise UserError(f"{where}: expected length_mm above 0, got {length_mm:g}")
    low, high = (_number(record, f"ci95_{end}_mm", where) for end in ("low", "high"))
    return _Row(length_mm=length_mm, ci95_mm=None if low is None or high is None else (low, high))


def _track_id(record: Mapping[str, str | None], where: str) -> int:
    text = record["track_id"] or ""
    try:
        return int(text)
    except ValueError:
        raise UserError(f"{where}: expected a whole number as track_id, got '{text}'") from None


def _number(record: Mapping[str, str | None], column: str, where: str) -> float | None:
    """Read a finite number, None where the field is empty or not there."""
    text = (record.get(column) or "").strip()
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"{where}: expected {column} as a number or empty, got '{text}'")
    return value
