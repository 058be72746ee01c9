"""The tables that `evaluate` reads: what is written is read, faults are named with their line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import UserError
from stream_dmr.evaluation.length_tables import (
    is_histogram,
    read_histogram,
    read_lengths,
    read_truth,
)

lengths = st.dictionaries(st.integers(1, 999), st.floats(1.0, 1e4), min_size=1, max_size=20)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tables") / "table.csv"


def table(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@given(truth=lengths)
def test_a_truth_is_read_as_it_was_written(path: Path, truth: dict[int, float]):
    rows = "".join(f"{track_id},{length!r}\n" for track_id, length in truth.items())
    assert read_truth(table(path, f"track_id,length_mm\n{rows}")) == truth


def test_a_fish_without_a_length_has_none_and_other_columns_are_ignored(path: Path):
    text = "track_id,length_mm,length_std_mm,ci95_low_mm,ci95_high_mm,x\n1,,,,,a\n2,10,1,8,12,b\n"
    rows = read_lengths(table(path, text))
    assert rows[1].length_mm is None
    assert (rows[2].std_mm, rows[2].ci95_mm) == (1.0, (8.0, 12.0))


@given(counts=st.lists(st.integers(0, 50), min_size=1, max_size=12).filter(any))
def test_a_histogram_keeps_edges_and_counts(path: Path, counts: list[int]):
    edges = 500.0 + 50.0 * np.arange(len(counts) + 1)
    bins = zip(edges, edges[1:], counts, strict=False)
    rows = "".join(f"{low},{high},{count}\n" for low, high, count in bins)
    known = read_histogram(table(path, f"bin_low_mm,bin_high_mm,count\n{rows}"))
    assert is_histogram(path)
    assert not known.is_shares
    np.testing.assert_array_equal(known.histogram.edges_mm, edges)
    np.testing.assert_array_equal(known.histogram.counts, counts)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("track_id,length_mm\n1,10\n1,11\n", "line 3: expected one row per fish"),
        ("track_id,length_mm\n1,-4\n", "line 2: expected length_mm above 0"),
        ("track_id,length_mm\n1,long\n", "line 2: expected length_mm as a number"),
        ("track_id,length_mm\none,10\n", "line 2: expected a whole number as track_id"),
        ("track_id\n1\n", "expected the columns track_id and length_mm"),
        ("track_id,length_mm\n1,\n", "expected a length for track 1"),
        ("track_id,length_mm\n", "expected a row for each fish"),
        ("", "got an empty file"),
    ],
)
def test_faults_of_a_truth_are_named(path: Path, text: str, named: str):
    with pytest.raises(UserError, match=named):
        read_truth(table(path, text))


@pytest.mark.parametrize(
    ("rows", "named"),
    [
        ("500,550,1\n560,600,1\n", "line 3: expected a bin from 550 mm on"),
        ("550,500,1\n", "line 2: expected a bin that ends after it begins"),
        ("500,550,-1\n", "line 2: expected count from 0 on"),
        ("500,550,\n", "line 2: expected a number as count"),
        ("500,550,0\n", "expected at least one bin with fish"),
    ],
)
def test_faults_of_a_histogram_are_named(path: Path, rows: str, named: str):
    with pytest.raises(UserError, match=named):
        read_histogram(table(path, f"bin_low_mm,bin_high_mm,count\n{rows}"))


def test_bytes_that_are_no_text_are_named(path: Path):
    path.write_bytes(b"track_id,length_mm\n\xff\xfe,1\n")
    with pytest.raises(UserError, match="UTF-8"):
        read_lengths(path)
