"""Where a fit begins: from the mask alone, and from the frame before."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.fitting.body import LOG_SIZE, ROOT_TRANSLATION, Body, MeshLevels
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.heading import is_reversed
from stream_dmr.fitting.solver.descent import evaluate
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.starts import cold_starts, recentered
from stream_dmr.fitting.target import Target
from stream_dmr.template.template_file import load_template
from tests.support.shapes import crop_of, fish_rig, fish_template, pose, seeds

TEMPLATE, RIG = fish_template(), fish_rig()
BODY = Body.from_template(TEMPLATE)
TOWARD_CAMERA = np.array([0.0, 0.0, 1.0])
few = settings(max_examples=10)


def posed(seed: int) -> tuple[Target, np.ndarray]:
    rng = np.random.default_rng(seed)
    flat = pose(rng, in_plane_rad=rng.uniform(-np.pi, np.pi))
    return Target.from_crop(crop_of(flat, RIG), plane_normal=TOWARD_CAMERA), flat[0].numpy()


def problem_of(target: Target) -> Problem:
    return Problem.from_settings(FitMeshSettings(), BODY, target, with_smoothness=False)


def middle_px(pixels: np.ndarray) -> np.ndarray:
    return (pixels.min(axis=0) + pixels.max(axis=0)) / 2


@few
@given(seed=seeds)
def test_a_cold_start_is_near_the_answer(seed: int):
    target, truth = posed(seed)
    starts = cold_starts(target, TEMPLATE)
    assert starts.shape == (24, len(truth))  # 3 bends, 4 rolls, 2 ends
    problem = problem_of(target)
    ious = [evaluate(problem, start, False).iou for start in starts]
    assert max(ious) > 0.5
    sizes = np.exp(starts[:, LOG_SIZE] - truth[LOG_SIZE])
    assert np.abs(np.log(sizes)).min() < 0.25


@few
@given(seed=seeds, is_turned=st.booleans())
def test_a_known_heading_halves_the_starts(seed: int, is_turned: bool):
    target, truth = posed(seed)
    points = evaluate(problem_of(target), truth, False).rendering.points
    head, tail = points[BODY.num_vertices], points[BODY.num_vertices + 2]
    heading = (head - tail)[:2] * (-1 if is_turned else 1)
    starts = cold_starts(target._replace(heading=heading), TEMPLATE)
    assert 0 < len(starts) < len(cold_starts(target, TEMPLATE))
    assert not is_reversed(starts, heading).any()


@few
@given(seed=seeds, shift=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)))
def test_a_warm_start_moves_the_silhouette_onto_the_mask(seed: int, shift: tuple[float, float]):
    target, truth = posed(seed)
    problem, before = problem_of(target), truth.copy()
    before[ROOT_TRANSLATION] += shift
    after = recentered(problem, before)
    rows, columns = np.nonzero(target.mask > 0.5)
    pixels = evaluate(problem, after, False).rendering.pixels
    expected = middle_px(np.stack([columns, rows], axis=1).astype(float))
    assert np.abs(middle_px(pixels) - expected).max() < 1.5
    moved = np.flatnonzero(after != before)
    assert set(moved) <= {3, 4}


@pytest.mark.parametrize("name", ["halibut", "eel"])
def test_each_mesh_level_is_the_same_body_with_fewer_faces(name: str):
    levels = MeshLevels.from_template(load_template(name), max_faces=900)
    counts = [len(level.faces) for level in levels]
    assert counts == sorted(counts, reverse=True)
    assert len(levels.fine.faces) <= 900
    assert len(levels.coarse.faces) <= 600
    for level in levels:
        np.testing.assert_array_equal(level.joints, levels.full.joints)
        extent = np.ptp(level.points[: level.num_vertices], axis=0)
        full = np.ptp(levels.full.points[: levels.full.num_vertices], axis=0)
        np.testing.assert_allclose(extent, full, rtol=0.05)


def test_a_level_that_needs_no_simplifying_is_the_one_above():
    levels = MeshLevels.from_template(TEMPLATE, max_faces=3000)
    assert levels.full is levels.fine is levels.coarse
