from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import wasserstein_distance

from stream_dmr.errors import UserError
from stream_dmr.evaluation import evaluate, summary_rows
from stream_dmr.metrics import (
    distribution_errors,
    fish_errors,
    histogram_bias_mm,
    histogram_emd_mm,
    histogram_kl,
    histogram_rmsd,
    is_covered,
    length_histogram,
)

lengths_in_range = st.lists(st.floats(500, 1000), min_size=1, max_size=30).map(np.array)


def test_histogram_of_known_lengths():
    """Both ends are kept, what is outside is not."""
    histogram = length_histogram(
        np.array([499.9, 500, 549, 550, 999, 1000, 1000.1]), bin_width_mm=50.0
    )
    assert histogram.counts.tolist() == [2, 1, 0, 0, 0, 0, 0, 0, 0, 2]
    assert histogram.shares.sum() == pytest.approx(1)
    assert histogram.centers_mm[0] == 525


@pytest.mark.parametrize("width", [30.0, 700.0])
def test_bins_must_fill_the_range(width):
    with pytest.raises(ValueError, match="bins that fill"):
        length_histogram(np.array([600.0]), bin_width_mm=width)


def test_no_fish_in_range_has_no_distribution():
    assert length_histogram(np.array([100.0])) is None
    assert distribution_errors(np.zeros(0), np.array([700.0])) is None


@given(st.lists(st.floats(500, 799), min_size=1, max_size=30), st.integers(0, 4))
def test_emd_and_bias_of_a_shifted_histogram_are_the_shift(lengths, num_bins):
    truth = length_histogram(np.floor(np.array(lengths)))
    predicted = length_histogram(np.floor(np.array(lengths)) + 50 * num_bins)
    assert histogram_emd_mm(predicted, truth) == pytest.approx(50 * num_bins)
    assert histogram_bias_mm(predicted, truth) == pytest.approx(50 * num_bins)


@given(lengths_in_range, lengths_in_range)
def test_emd_is_the_area_between_the_cumulated_shares_and_at_least_the_bias(a, b):
    predicted, truth = length_histogram(a), length_histogram(b)
    expected = 50 * np.abs(np.cumsum(predicted.shares) - np.cumsum(truth.shares)).sum()
    emd = histogram_emd_mm(predicted, truth)
    assert emd == pytest.approx(expected, abs=1e-9)
    assert emd >= abs(histogram_bias_mm(predicted, truth)) - 1e-9


@given(lengths_in_range, lengths_in_range)
def test_binning_moves_the_emd_by_less_than_a_bin(a, b):
    binned = histogram_emd_mm(length_histogram(a), length_histogram(b))
    assert abs(binned - wasserstein_distance(a, b)) <= 50 + 1e-9


@given(lengths_in_range, lengths_in_range)
def test_distances_vanish_between_equals_only(a, b):
    predicted, truth = length_histogram(a), length_histogram(b)
    assert histogram_kl(truth, truth) == histogram_rmsd(truth, truth) == 0
    assert np.isfinite(histogram_kl(predicted, truth))
    assert histogram_kl(predicted, truth) >= 0
    if not np.array_equal(predicted.shares, truth.shares):
        assert histogram_rmsd(predicted, truth) > 0


def test_rmsd_and_kl_by_hand():
    """Two bins: 3 and 1 fish against 2 and 2."""
    kept = {"bin_width_mm": 250.0, "kept_mm": (500.0, 1000.0)}
    predicted = length_histogram(np.array([600.0, 600, 600, 900]), **kept)
    truth = length_histogram(np.array([600.0, 600, 900, 900]), **kept)
    assert histogram_rmsd(predicted, truth) == pytest.approx(0.25)
    by_hand = 0.5 * np.log(0.5 / 0.7) + 0.5 * np.log(0.5 / 0.3)  # shares with 1/2 fish added
    assert histogram_kl(predicted, truth) == pytest.approx(by_hand)


def test_fish_errors_by_hand():
    truth = np.array([500.0, 1000.0, 800.0])
    errors = fish_errors(truth + np.array([10.0, -40.0, 0.0]), truth)
    assert errors.mean_absolute_mm == pytest.approx(50 / 3)
    assert errors.median_absolute_mm == 10
    assert errors.p90_absolute_mm == pytest.approx(10 + 0.8 * 30)
    assert errors.bias_mm == pytest.approx(-10)
    assert errors.mean_absolute_percent == pytest.approx(2)
    assert errors.median_absolute_percent == pytest.approx(2)
    assert errors.p90_absolute_percent == pytest.approx(2 + 0.8 * 2)
    assert errors.bias_percent == pytest.approx(-2 / 3)


def test_interval_covers_its_ends():
    intervals = np.array([[1.0, 2.0], [1.0, 2.0], [1.0, 2.0]])
    assert is_covered(np.array([1.0, 2.0, 2.1]), intervals).tolist() == [True, True, False]


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


LENGTHS = """track_id,length_mm,length_std_mm,ci95_low_mm,ci95_high_mm,status
1,707.0,10,690,720,measured
2,,,,,too few good frames (1 of 3)
4,582.0,5,575,590,measured
9,650.0,5,640,660,measured
"""
TRUTH = "track_id,length_mm\n1,700\n2,800\n3,900\n4,600\n"


def test_evaluation_pairs_by_track_and_names_the_rest(tmp_path):
    evaluation = evaluate(write(tmp_path, "a.csv", LENGTHS), write(tmp_path, "b.csv", TRUTH))
    assert [f.track_id for f in evaluation.fish] == [1, 2, 3, 4]
    assert [f.error_mm for f in evaluation.fish] == [7.0, None, None, -18.0]
    assert (evaluation.unmeasured, evaluation.missing, evaluation.unknown) == ((2,), (3,), (9,))
    assert evaluation.fraction_measured == 0.5
    assert evaluation.coverage == 0.5
    assert evaluation.errors.mean_absolute_percent == pytest.approx(2.0)
    rows = dict(summary_rows(evaluation))
    assert rows["fish measured"] == "2 of 4"
    assert rows["not in the lengths, track"] == "3"
    assert rows["mean absolute error"] == "12.5 mm, 2.00 %"
    assert rows["truth within the 95 % interval"] == "50 %"


def test_nothing_measured_is_no_error(tmp_path):
    lengths = write(tmp_path, "a.csv", LENGTHS.splitlines()[0] + "\n")
    evaluation = evaluate(lengths, write(tmp_path, "b.csv", TRUTH))
    assert evaluation.errors is evaluation.coverage is evaluation.distribution is None
    assert dict(summary_rows(evaluation)) == {
        "fish measured": "0 of 4",
        "not in the lengths, track": "1, 2, 3, 4",
    }


def test_lengths_without_intervals_have_no_coverage(tmp_path):
    lengths = write(tmp_path, "a.csv", "track_id,length_mm\n1,690\n")
    assert evaluate(lengths, write(tmp_path, "b.csv", TRUTH)).coverage is None


def test_an_interval_may_reach_below_zero(tmp_path):
    text = "track_id,length_mm,ci95_low_mm,ci95_high_mm\n1,600,-20,1220\n"
    lengths = write(tmp_path, "a.csv", text)
    assert evaluate(lengths, write(tmp_path, "b.csv", TRUTH)).coverage == 1.0


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ("", "expected the columns track_id and length_mm, got an empty file"),
        ("id,length_mm\n1,700\n", "got id, length_mm"),
        ("track_id,length_mm\n", "expected a row for each fish, got none"),
        ("track_id,length_mm\n1,\n", "expected a length for track 1"),
        ("track_id,length_mm\n1\n", "expected a length for track 1"),
        (
            "track_id,length_mm\n1,7oo\n",
            "line 2: expected length_mm as a number or empty, got '7oo'",
        ),
        ("track_id,length_mm\n1,nan\n", "line 2: expected length_mm as a number or empty"),
        ("track_id,length_mm\n1,-5\n", "line 2: expected length_mm above 0, got -5"),
        ("track_id,length_mm\nx,700\n", "line 2: expected a whole number as track_id, got 'x'"),
        ("track_id,length_mm\n1,7\n1,8\n", "line 3: expected one row a fish, got track 1 again"),
    ],
)
def test_bad_tables_are_refused_in_one_line(tmp_path, truth, message):
    lengths = write(tmp_path, "a.csv", LENGTHS)
    with pytest.raises(UserError) as refusal:
        evaluate(lengths, write(tmp_path, "b.csv", truth))
    assert message in str(refusal.value)
    assert "b.csv" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_files_that_are_no_tables_are_refused(tmp_path):
    truth = write(tmp_path, "b.csv", TRUTH)
    with pytest.raises(UserError, match="can't be read"):
        evaluate(tmp_path / "none.csv", truth)
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(UserError, match="CSV file in UTF-8"):
        evaluate(tmp_path / "a.csv", truth)
