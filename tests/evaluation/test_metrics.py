import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import entropy, wasserstein_distance

from stream_dmr.evaluation.length_errors import (
    EvaluateSettings,
    fish_errors,
    histogram_bias_mm,
    histogram_emd_mm,
    histogram_kl,
    histogram_rmsd,
    interval_figures,
    is_covered,
    length_histogram,
)

lengths_in_range = st.lists(st.floats(500, 1000), min_size=1, max_size=30).map(np.array)


SETTINGS = EvaluateSettings()


def histogram(lengths, **settings):
    edges_mm = EvaluateSettings(**settings).edges_mm()
    return length_histogram(np.array(lengths, np.float64), edges_mm)


def test_histogram_of_known_lengths():
    """Both ends are kept, what is outside is not."""
    found = histogram([499.9, 500, 549, 550, 999, 1000, 1000.1])
    assert found.counts.tolist() == [2, 1, 0, 0, 0, 0, 0, 0, 0, 2]
    assert found.shares.sum() == pytest.approx(1)
    assert found.centers_mm[0] == 525


def test_the_bins_are_settings():
    found = histogram([50, 130, 149, 160], first_bin_mm=100.0, bin_width_mm=25.0, num_bins=2)
    assert found.edges_mm.tolist() == [100, 125, 150]
    assert found.counts.tolist() == [0, 2]


def test_no_fish_in_range_has_no_histogram():
    assert histogram([100.0]) is None


@given(st.lists(st.floats(500, 799), min_size=1, max_size=30), st.integers(0, 4))
def test_emd_and_bias_of_a_shifted_histogram_are_the_shift(lengths, num_bins):
    truth = histogram(np.floor(lengths))
    predicted = histogram(np.floor(lengths) + 50 * num_bins)
    assert histogram_emd_mm(predicted, truth) == pytest.approx(50 * num_bins)
    assert histogram_bias_mm(predicted, truth) == pytest.approx(50 * num_bins)


@given(lengths_in_range, lengths_in_range)
def test_emd_is_the_area_between_the_cumulated_shares_and_at_least_the_bias(a, b):
    predicted, truth = histogram(a), histogram(b)
    expected = 50 * np.abs(np.cumsum(predicted.shares) - np.cumsum(truth.shares)).sum()
    emd = histogram_emd_mm(predicted, truth)
    assert emd == pytest.approx(expected, abs=1e-9)
    assert emd >= abs(histogram_bias_mm(predicted, truth)) - 1e-9


@given(lengths_in_range, lengths_in_range)
def test_binning_moves_the_emd_by_less_than_a_bin(a, b):
    binned = histogram_emd_mm(histogram(a), histogram(b))
    assert abs(binned - wasserstein_distance(a, b)) <= 50 + 1e-9


@given(lengths_in_range, lengths_in_range)
def test_distances_vanish_between_equals_only(a, b):
    predicted, truth = histogram(a), histogram(b)
    assert histogram_kl(truth, truth, pseudo_count=0.5) == histogram_rmsd(truth, truth) == 0
    kl = histogram_kl(predicted, truth, pseudo_count=0.5)
    assert np.isfinite(kl)
    assert kl >= -1e-12
    if not np.array_equal(predicted.shares, truth.shares):
        assert histogram_rmsd(predicted, truth) > 0


def test_rmsd_and_kl_by_hand():
    """Two bins: 3 and 1 fish against 2 and 2."""
    bins = {"bin_width_mm": 250.0, "num_bins": 2}
    predicted = histogram([600.0, 600, 600, 900], **bins)
    truth = histogram([600.0, 600, 900, 900], **bins)
    assert histogram_rmsd(predicted, truth) == pytest.approx(0.25)
    by_hand = 0.5 * np.log(0.5 / 0.7) + 0.5 * np.log(0.5 / 0.3)  # shares with 1/2 fish added
    assert histogram_kl(predicted, truth, pseudo_count=0.5) == pytest.approx(by_hand)


@given(lengths_in_range, lengths_in_range)
def test_kl_is_scipy_s(a, b):
    predicted, truth = histogram(a), histogram(b)
    expected = entropy(truth.counts + 0.1, predicted.counts + 0.1)
    assert histogram_kl(predicted, truth, pseudo_count=0.1) == pytest.approx(expected, abs=1e-9)


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


def figures_of(rng, *, std, promised):
    truth = rng.uniform(500, 1000, 4000)
    predicted = truth + rng.normal(0, std, len(truth))
    half = 1.96 * promised * np.ones_like(truth)
    return interval_figures(
        predicted_mm=predicted,
        truth_mm=truth,
        intervals_mm=np.stack([predicted - half, predicted + half], axis=1),
        stds_mm=np.full_like(truth, promised),
    )


@pytest.mark.parametrize(("promised", "coverage"), [(20.0, 0.95), (10.0, 0.673), (40.0, 1.0)])
def test_intervals_are_right_where_the_std_is(promised, coverage):
    found = figures_of(np.random.default_rng(0), std=20.0, promised=promised)
    assert found.coverage == pytest.approx(coverage, abs=0.02)
    assert found.nees == pytest.approx((20.0 / promised) ** 2, rel=0.1)
    assert found.mean_width == pytest.approx(3.92 * promised * np.log(2) / 500, rel=0.05)
