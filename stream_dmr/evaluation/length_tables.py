"""Read the tables of `stream-dmr evaluate`: lengths, true lengths, and histograms of them.

- Lengths, as in a run's lengths.csv: track_id, length_mm and, if present, length_std_mm,
  ci95_low_mm, ci95_high_mm; other columns are ignored. An empty length_mm: not measured.
- Truth: track_id, length_mm.
- A histogram: bin_low_mm, bin_high_mm and either count (fish) or share (at any scale), one row per
  bin, each beginning where the previous one ends.
"""

import csv
import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stream_dmr.errors import UserError
from stream_dmr.evaluation.length_errors import Histogram
from stream_dmr.files import open_file

Interval = tuple[float, float]
_Record = Mapping[str, str | None]


@dataclass(frozen=True, kw_only=True)
class LengthRow:
    """One fish of a table of lengths."""

    length_mm: float | None  # None: not measured
    std_mm: float | None = None
    ci95_mm: Interval | None = None


@dataclass(frozen=True, kw_only=True)
class KnownHistogram:
    """A histogram of true lengths."""

    histogram: Histogram
    is_shares: bool  # heights at any scale; the number of fish is unknown


def is_histogram(path: Path) -> bool:
    columns, _ = _open(path)
    return "bin_low_mm" in columns


def read_lengths(path: Path) -> dict[int, LengthRow]:
    """Rows by track_id, in the file's order. Raises UserError for a file that can't be read."""
    rows: dict[int, LengthRow] = {}
    for where, record in _records(path, "track_id", "length_mm"):
        track_id = _track_id(record, where)
        if track_id in rows:
            raise UserError(f"{where}: expected one row per fish, got track {track_id} again")
        rows[track_id] = _row(record, where)
    return rows


def read_truth(path: Path) -> dict[int, float]:
    """True length in mm by track_id. Raises UserError if a fish has none."""
    truth: dict[int, float] = {}
    for track_id, row in read_lengths(path).items():
        if row.length_mm is None:
            raise UserError(f"{path}: expected a length for track {track_id}, got an empty field")
        truth[track_id] = row.length_mm
    if not truth:
        raise UserError(f"{path}: expected a row for each fish, got none")
    return truth


def read_histogram(path: Path) -> KnownHistogram:
    """Bins and heights. Raises UserError for gaps, overlaps and negative heights."""
    columns, _ = _open(path)
    height = "count" if "count" in columns else "share"
    edges_mm: list[float] = []
    heights: list[float] = []
    for where, record in _records(path, "bin_low_mm", "bin_high_mm", height):
        low, high, value = (
            _required(record, name, where) for name in ("bin_low_mm", "bin_high_mm", height)
        )
        if edges_mm and not math.isclose(low, edges_mm[-1]):
            raise UserError(f"{where}: expected a bin from {edges_mm[-1]:g} mm on, got {low:g}")
        if not 0 <= low < high:
            raise UserError(
                f"{where}: expected a bin that ends after it begins, got {low:g} to {high:g}"
            )
        if value < 0:
            raise UserError(f"{where}: expected {height} from 0 on, got {value:g}")
        edges_mm += [high] if edges_mm else [low, high]
        heights.append(value)
    if sum(heights) == 0:
        raise UserError(f"{path}: expected at least one bin with fish in it, got none")
    histogram = Histogram(edges_mm=np.array(edges_mm), counts=np.array(heights))
    return KnownHistogram(histogram=histogram, is_shares=height == "share")


def _records(path: Path, *required: str) -> Iterator[tuple[str, _Record]]:
    """Each row with its file and line, for messages. Raises UserError for missing columns."""
    columns, records = _open(path)
    if not set(required) <= set(columns):
        raise UserError(
            f"{path}: expected the columns {', '.join(required[:-1])} and {required[-1]}, "
            f"got {', '.join(columns) or 'an empty file'}"
        )
    yield from records


def _open(path: Path) -> tuple[list[str], list[tuple[str, _Record]]]:
    try:
        with open_file(path) as file:
            text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
            reader = csv.DictReader(text, strict=True)
            columns = list(reader.fieldnames or [])
            return columns, [(f"{path}, line {reader.line_num}", record) for record in reader]
    except OSError as problem:
        raise UserError(f"{path}: can't be read ({problem.strerror})") from problem
    except (UnicodeDecodeError, csv.Error) as problem:
        raise UserError(f"{path}: expected a CSV file in UTF-8 ({problem})") from problem


def _row(record: _Record, where: str) -> LengthRow:
    length_mm, std_mm = (_number(record, name, where) for name in ("length_mm", "length_std_mm"))
    for name, value in (("length_mm", length_mm), ("length_std_mm", std_mm)):
        if value is not None and value <= 0:
            raise UserError(f"{where}: expected {name} above 0, got {value:g}")
    low, high = (_number(record, f"ci95_{end}_mm", where) for end in ("low", "high"))
    ci95_mm = None if low is None or high is None else (low, high)
    return LengthRow(length_mm=length_mm, std_mm=std_mm, ci95_mm=ci95_mm)


def _track_id(record: _Record, where: str) -> int:
    text = record["track_id"] or ""
    try:
        return int(text)
    except ValueError:
        raise UserError(f"{where}: expected a whole number as track_id, got '{text}'") from None


def _required(record: _Record, column: str, where: str) -> float:
    value = _number(record, column, where)
    if value is None:
        raise UserError(f"{where}: expected a number as {column}, got an empty field")
    return value


def _number(record: _Record, column: str, where: str) -> float | None:
    """A finite number; None if the field is empty or missing."""
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
