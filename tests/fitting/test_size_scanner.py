"""The expected size: of known densities, and of simulated fish whose sizes are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from stream_dmr.fitting.body import LOG_SIZE, Body, MeshLevels, rest_vector
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.size import SizeScanner, mean_and_std
from stream_dmr.fitting.solver.contour_solver import ContourSolver
from stream_dmr.fitting.solver.descent import WARM_DAMPING, descend, evaluate, only_size, scan_sizes
from stream_dmr.fitting.solver.problem import Options, Problem, prior_loss
from stream_dmr.fitting.target import Target
from stream_dmr.template.template_file import load_template
from tests.support.batches import PLANE_NORMAL, crops_of_poses, moved

OFFSETS = np.linspace(-0.3, 0.3, 13)
FIVE = np.array([-0.1, -0.04, 0.0, 0.04, 0.1])
BODY = Body.from_template(load_template("halibut"))
BODIES = MeshLevels(BODY, BODY, BODY)
SETTINGS = FitMeshSettings()


@settings(deadline=None)
@given(mean=st.floats(-0.1, 0.1), std=st.floats(0.03, 0.08))
def test_of_a_normal_density_they_are_its_own(mean, std):
    found = mean_and_std(OFFSETS, 0.5 * ((OFFSETS - mean) / std) ** 2)
    assert found == pytest.approx((mean, std), abs=0.01)


@given(shift=st.floats(-1e3, 1e3))
def test_a_constant_changes_nothing(shift):
    nats = 40.0 * np.abs(OFFSETS - 0.05)
    assert mean_and_std(OFFSETS, nats + shift) == pytest.approx(mean_and_std(OFFSETS, nats))


def test_the_mean_leans_to_where_sizes_stay_likely():
    """Short is impossible, long is merely unlikely: the fish is longer than the best fit."""
    nats = np.where(OFFSETS < 0, 400.0, 12.0) * np.abs(OFFSETS)
    mean, std = mean_and_std(OFFSETS, nats)
    assert 0.03 < mean < std + 0.03


def test_of_a_single_size_that_was_tried_it_is_the_mean():
    mean, std = mean_and_std(np.array([0.03]), np.array([7.0]))
    assert mean == pytest.approx(0.03, abs=0.002)
    assert 0.03 < std < 0.15


def test_without_any_preference_nothing_is_known():
    _, std = mean_and_std(OFFSETS, np.zeros(len(OFFSETS)))
    assert std > 0.15


@settings(deadline=None)
@given(
    points=st.lists(
        st.tuples(st.integers(-30, 30), st.integers(-500, 500)),
        min_size=2,
        max_size=9,
        unique_by=lambda point: point[0],
    )
)
def test_between_the_sizes_tried_the_curve_is_scipy_s(points):
    """Slow twin: SciPy's interpolator, on the same grid."""
    hundredths, tenths = map(np.array, zip(*sorted(points), strict=True))
    offsets, nats = hundredths / 100, tenths / 10
    x = np.arange(offsets[0] - 0.15, offsets[-1] + 0.15, 0.002)
    curve = PchipInterpolator(offsets, nats)(x.clip(offsets[0], offsets[-1]))
    first, last = np.diff(nats)[[0, -1]] / np.diff(offsets)[[0, -1]]
    curve += np.maximum(offsets[0] - x, 0) * max(-first, 10.0)
    curve += np.maximum(x - offsets[-1], 0) * max(last, 10.0)
    density = np.exp(curve.min() - curve)
    mean = np.average(x, weights=density)
    std = np.sqrt(np.average((x - mean) ** 2, weights=density))
    assert mean_and_std(offsets, nats) == pytest.approx((mean, std), abs=0.002)


@pytest.fixture(scope="module")
def known():
    """Three targets, and the fits found from near the truth."""
    crops, flats = crops_of_poses("halibut", 5, batch=3)
    solver = ContourSolver(BODIES, SETTINGS)
    targets = [Target.from_crop(crop, plane_normal=PLANE_NORMAL) for crop in crops]
    starts = moved(flats, 5)
    return [(t, solver.refine(t, s), f) for t, s, f in zip(targets, starts, flats, strict=True)]


def scanned(target, flat, *, max_excess=np.inf):
    options = Options(4, SETTINGS.tolerance, WARM_DAMPING)
    return scan_sizes(problem_of(target), flat, only_size(len(flat)), FIVE, max_excess, options)


def problem_of(target):
    return Problem.from_settings(SETTINGS, BODY, target, with_smoothness=False)


def test_every_fit_of_a_scan_has_the_size_it_is_to_have(known):
    for target, best, _ in known:
        fits, losses, log_volumes, *_ = scanned(target, best.parameters)
        np.testing.assert_allclose(fits[:, LOG_SIZE], best.parameters[LOG_SIZE] + FIVE, atol=1e-12)
        assert np.isfinite(losses).all()
        assert np.isfinite(log_volumes).all()


def test_where_sizes_are_likely_a_scan_is_nearly_as_good_as_a_long_fit(known):
    held, options = only_size(len(rest_vector(2))), Options(30, SETTINGS.tolerance, WARM_DAMPING)
    for target, best, _ in known:
        _, losses, *_ = scanned(target, best.parameters)
        for offset, loss in zip(FIVE, losses, strict=True):
            start = best.parameters.copy()
            start[LOG_SIZE] += offset
            alone = descend(problem_of(target), start, held, options).loss
            if alone < losses[2] + 8 * SETTINGS.nat:
                assert loss <= alone + 3 * SETTINGS.nat


def test_a_size_is_looked_for_where_its_neighbour_is_headed(known):
    for target, best, _ in known:
        fits, _, _, next_steps, _ = scanned(target, best.parameters)
        straight, ahead = fits[2].copy(), fits[2] + 0.04 * next_steps[2]
        straight[LOG_SIZE] += 0.04
        assert ahead[LOG_SIZE] == pytest.approx(straight[LOG_SIZE])
        assert loss_of(target, ahead) < loss_of(target, straight)


def loss_of(target, flat):
    problem = problem_of(target)
    return evaluate(problem, flat, False).terms @ problem.lambdas + prior_loss(problem, flat)


def test_scan_ends_at_sizes_that_exceed_the_loss(known):
    for target, best, _ in known:
        _, everywhere, *_ = scanned(target, best.parameters)
        max_excess = np.median(everywhere) - everywhere[2]
        _, losses, *_ = scanned(target, best.parameters, max_excess=max_excess)
        for outwards in (slice(2, None), slice(2, None, -1)):
            ends = everywhere[outwards] >= everywhere[2] + max_excess
            tried = np.append(True, ~np.logical_or.accumulate(ends)[:-1])
            expected = np.where(tried, everywhere[outwards], np.inf)
            np.testing.assert_array_equal(losses[outwards], expected)


def test_known_fish_have_the_size_to_be_expected(known):
    """To a few percent by one mask, and within what the std says."""
    scanner = SizeScanner(BODIES, SETTINGS)
    for target, best, flat in known:
        sized, std = scanner.expected(target, best)
        assert sized.parameters[LOG_SIZE] == pytest.approx(flat[LOG_SIZE], abs=3 * std + 0.01)
        assert 0.003 < std < 0.3
        assert sized.iou > best.iou - 0.05


def test_rougher_edges_say_less(known):
    target, best, _ = known[0]
    stds = [
        SizeScanner(BODIES, FitMeshSettings(edge_std_px=px)).expected(target, best)[1]
        for px in (0.5, 1.0, 2.0)
    ]
    assert stds == sorted(stds)


def test_the_paper_s_ways_are_left_alone():
    assert FitMeshSettings().scans_sizes
    assert not FitMeshSettings(solver="adam").scans_sizes
    assert not FitMeshSettings(deformation="linear-blend").scans_sizes
    assert not FitMeshSettings(scan_iterations=0).scans_sizes
