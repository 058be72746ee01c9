"""Cells of the tables: exact times, six decimals, blanks."""

from dataclasses import dataclass, fields
from decimal import Decimal
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import LengthEstimate
from stream_dmr.store.run_tables import FishRow
from stream_dmr.tables import cell, cells, column_kinds, read_rows, seconds, write_table
from tests.support.final_estimates import fish


@given(st.integers(-(2**63), 2**63 - 1))
def test_seconds_are_exact(timestamp_ns: int):
    text = seconds(timestamp_ns)
    assert Decimal(text) == Decimal(timestamp_ns).scaleb(-9)
    assert len(text.partition(".")[2]) == 9


@given(st.floats(-1e6, 1e6))
def test_numbers_are_rounded_to_six_decimals(value: float):
    assert abs(float(cell(value)) - value) <= 0.5e-6 + 1e-9


def test_cells_of_other_kinds():
    texts = ["", "true", "false", "7", "cod"]
    assert [cell(value) for value in (None, True, False, 7, "cod")] == texts


@dataclass(frozen=True, kw_only=True)
class DepthRow(FishRow):
    depth_m: float | None  # of the water
    is_deep: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthEstimate(LengthEstimate):
    depth_m: float | None = 3.25
    is_deep: bool = True


def test_a_column_is_declared_once(tmp_path: Path):
    """A field is a column: written from the message's field, read, in Parquet, in the docs."""
    estimate = DepthEstimate(**{f.name: getattr(fish(7), f.name) for f in fields(LengthEstimate)})
    others = {"ci95_low_mm": 1.0, "ci95_high_mm": None, "first_time": "0.5", "last_time": "1.5"}
    path = tmp_path / "lengths.csv"
    write_table(path, column_kinds(DepthRow), [cells(DepthRow, estimate, **others)])
    (row,) = read_rows(path, DepthRow)
    assert (row.track_id, row.ci95_low_mm, row.ci95_high_mm) == (7, 1.0, None)
    assert (row.first_time, row.depth_m, row.is_deep) == (0.5, 3.25, True)
    assert column_kinds(DepthRow)["depth_m"] is float
