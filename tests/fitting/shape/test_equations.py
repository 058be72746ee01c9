"""The least squares of pose and shape: the pose's part is the fit's, the shape's goes uphill."""

import numpy as np
import pytest

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.space import (
    BREADTH,
    LEFT,
    NUM_COEFFICIENTS,
    RIGHT,
    THICKNESS,
    directions,
    individual_covariance,
    reshaped,
)
from stream_dmr.fitting.shape.stock import shape_equations, without_deviation, without_pose
from stream_dmr.fitting.solver.contour_solver import loss_of
from stream_dmr.fitting.solver.descent import evaluate, normal_equations
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.target import Target
from stream_dmr.fitting.uncertainty import shape_std_ratio
from tests.support.stocks import TEMPLATE, TOWARD_CAMERA, broader, fish_of

SETTINGS = FitMeshSettings()
BODY = Body.from_template(TEMPLATE)
SLOPES = directions(BODY)


@pytest.fixture(scope="module")
def sample():
    return fish_of(broader(0.25), track_id=3, num_frames=1).samples[0]


def problem_of(sample, coefficients=None):
    shape = np.zeros(NUM_COEFFICIENTS) if coefficients is None else coefficients
    target = Target.from_crop(sample.crop, plane_normal=TOWARD_CAMERA)
    body = Body.from_template(reshaped(TEMPLATE, shape))
    return Problem.from_settings(SETTINGS, body, target, with_smoothness=False)


def test_the_block_of_the_pose_is_that_of_the_fit(sample):
    problem, n = problem_of(sample), len(sample.pose)
    H, g = normal_equations(problem, sample.pose, evaluate(problem, sample.pose, False).rendering)
    found = shape_equations(problem, sample.pose, SLOPES)
    np.testing.assert_allclose(found.H[:n, :n], H, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.g[:n], g, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found.H, found.H.T)
    assert found.H.shape == (n + NUM_COEFFICIENTS,) * 2


def test_the_gradient_in_the_shape_points_up_the_loss(sample):
    """Contour distances stand for the pixels of L_rec: the same way, not the same number."""
    g = shape_equations(problem_of(sample), sample.pose, SLOPES).g[len(sample.pose) :]
    steps = 1e-3 * np.eye(NUM_COEFFICIENTS)
    slope = np.array(
        [
            (
                loss_of(problem_of(sample, step), sample.pose)
                - loss_of(problem_of(sample, -step), sample.pose)
            )
            / 2e-3
            for step in steps
        ]
    )
    sides = slice(0, BREADTH.stop)
    cosine = g[sides] @ slope[sides] / np.linalg.norm(g[sides]) / np.linalg.norm(slope[sides])
    assert cosine > 0.9
    # The fish is broader than the body: each side is to become broader, too.
    assert g[LEFT].sum() < 0
    assert g[RIGHT].sum() < 0
    assert np.linalg.norm(g[THICKNESS]) < 0.3 * np.linalg.norm(g[sides])


def test_a_length_is_as_uncertain_as_the_shape(sample):
    problem, covariance = problem_of(sample), individual_covariance()
    std = shape_std_ratio(problem, sample.pose, SLOPES, covariance)
    assert 0.001 < std < 0.2
    none = shape_std_ratio(problem, sample.pose, SLOPES, np.zeros_like(covariance))
    assert none == 0.0
    twice = shape_std_ratio(problem, sample.pose, SLOPES, 4 * covariance)
    assert twice == pytest.approx(2 * std)
    more = covariance + np.diag(np.full(NUM_COEFFICIENTS, 0.01))
    assert shape_std_ratio(problem, sample.pose, SLOPES, more) > std


@pytest.mark.parametrize("largest", [1e2, 1e11])
def test_an_individuals_deviation_leaves_what_its_covariance_lets_pass(largest):
    rng = np.random.default_rng(3)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    H = axes @ np.diag(np.geomspace(1, largest, 6)) @ axes.T
    C = np.diag(np.geomspace(1e-4, 1e-1, 6))
    information, slope = without_deviation(H, (g := rng.normal(size=6)), np.linalg.inv(C))
    assert np.linalg.eigvalsh((information + information.T) / 2)[0] > 0
    np.testing.assert_allclose(information, np.linalg.inv(np.linalg.inv(H) + C), rtol=1e-3)
    np.testing.assert_allclose(slope, np.linalg.inv(np.eye(6) + H @ C) @ g, rtol=1e-3, atol=1e-6)


def test_a_pose_without_a_minimum_tells_no_shape():
    H = np.diag([1.0, -2.0, 5.0, 6.0])
    assert without_pose(H, np.ones(4), 2) is None
    curvature, _ = without_pose(np.abs(H) + 0.1, np.ones(4), 2)
    np.testing.assert_allclose(np.linalg.inv(curvature), np.linalg.inv(np.abs(H) + 0.1)[2:, 2:])
