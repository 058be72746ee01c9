"""The covariance of a fit's parameters: against a slow twin, and as settings say."""

import numpy as np
import pytest
from hypothesis import given, settings

from stream_dmr.fitting.body import (
    JOINT_TRANSLATION,
    LOG_SIZE,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_TRANSLATION,
    Body,
)
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.solver.descent import evaluate
from stream_dmr.fitting.solver.outline import project, visible_rim
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.solver.spine import KINDS, deform
from stream_dmr.fitting.target import Target
from stream_dmr.fitting.uncertainty import covariance, length_std_ratio
from stream_dmr.geometry import arc_length
from tests.support.shapes import crop_of, fish_rig, fish_template, pose, seeds

BODY, RIG = Body.from_template(fish_template()), fish_rig()
DEFAULT = FitMeshSettings()
few = settings(max_examples=8)


def posed(seed: int) -> tuple[Problem, np.ndarray]:
    rng = np.random.default_rng(seed)
    flat = pose(rng, in_plane_rad=rng.uniform(-3, 3))
    target = Target.from_crop(crop_of(flat, RIG), plane_normal=np.array([0.0, 0.0, 1.0]))
    problem = Problem.from_settings(DEFAULT, BODY, target, with_smoothness=False)
    return problem, flat[0].numpy()


def spread(problem: Problem, parameters: np.ndarray, options: FitMeshSettings) -> np.ndarray:
    rendering = evaluate(problem, parameters, False).rendering
    return covariance(problem, options, parameters, rendering)


def slow_information(problem: Problem, parameters: np.ndarray, weight: float) -> np.ndarray:
    """Edge by edge, with slopes by finite differences."""
    rendering = evaluate(problem, parameters, False).rendering
    visible = visible_rim(rendering)

    def middles(vector: np.ndarray) -> np.ndarray:
        points = deform(problem.body, problem.kind, vector)[: problem.body.num_vertices]
        pixels = project(points, problem.target.anchor, problem.target.K)
        return pixels[visible.edges].mean(axis=1)

    rows = np.empty((len(visible.edges), len(parameters)))
    for p, step in enumerate(1e-6 * np.eye(len(parameters))):
        moved = (middles(parameters + step) - middles(parameters - step)) / 2e-6
        rows[:, p] = (moved * visible.normals).sum(axis=1)
    return (rows * (weight * visible.lengths)[:, None]).T @ rows


@few
@given(seed=seeds)
def test_it_is_the_inverse_of_outline_and_priors(seed: int):
    problem, parameters = posed(seed)
    certain = FitMeshSettings(edge_std_px=0.5, edge_correlation_px=4.0)
    # The priors are what is left where all edges together say nothing.
    blind = FitMeshSettings(edge_std_px=0.5, edge_correlation_px=1e15)
    priors = np.linalg.inv(spread(problem, parameters, blind))
    expected = slow_information(problem, parameters, weight=1.0 / (4.0 * 0.5**2))
    found = np.linalg.inv(spread(problem, parameters, certain))
    np.testing.assert_allclose(found - priors, expected, atol=1e-5 * np.abs(expected).max())


@few
@given(seed=seeds)
def test_it_is_a_covariance_that_grows_with_the_edges_error(seed: int):
    problem, parameters = posed(seed)
    sharp, rough = (
        spread(problem, parameters, FitMeshSettings(edge_std_px=std)) for std in (0.5, 2.0)
    )
    np.testing.assert_array_equal(sharp, sharp.T)
    assert np.linalg.eigvalsh(sharp).min() > 0
    assert np.linalg.eigvalsh(rough - sharp).min() > -1e-9


def test_translations_of_joints_are_as_free_as_their_loss_term_leaves_them():
    problem, parameters = posed(1)
    blind = FitMeshSettings(edge_correlation_px=1e12)
    variance = np.diag(spread(problem, parameters, blind))[NUM_ROOT + JOINT_TRANSLATION.start]
    assert blind.lambda_translation * variance == pytest.approx(blind.nat / 2, rel=1e-3)


def test_without_priors_the_translations_are_as_free_as_by_default():
    problem, parameters = posed(1)
    paper = spread(problem, parameters, FitMeshSettings(prior_weight=0.0))
    np.testing.assert_array_equal(paper, spread(problem, parameters, DEFAULT))


@few
@given(seed=seeds)
def test_the_length_s_std_is_that_of_its_slope(seed: int):
    problem, parameters = posed(seed)
    found = spread(problem, parameters, DEFAULT)

    def log_length(vector: np.ndarray) -> float:
        points = deform(BODY, KINDS["spine"], vector)
        return float(np.log(arc_length(points[BODY.num_vertices + 3 :])))

    steps = 1e-6 * np.eye(len(parameters))
    slope = (
        np.array([log_length(parameters + s) - log_length(parameters - s) for s in steps]) / 2e-6
    )
    points = deform(BODY, KINDS["spine"], parameters)
    ratio = length_std_ratio(problem, parameters, points, found)
    assert ratio == pytest.approx(np.sqrt(slope @ found @ slope), rel=1e-5)
    assert slope[LOG_SIZE] == pytest.approx(1.0)  # the spine's size is its length


def test_sideways_motion_is_better_known_than_a_bend_towards_the_camera():
    problem, parameters = posed(2)
    std = np.sqrt(np.diag(spread(problem, parameters, DEFAULT)))
    bend = NUM_ROOT + NUM_PER_JOINT + 1  # of the second joint, about the camera's y
    assert std[ROOT_TRANSLATION].max() < 0.1 * std[bend]
