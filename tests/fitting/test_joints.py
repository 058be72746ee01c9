"""What both deformations share, and what each keeps: weights, blends, lengths, rest."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.fitting.body import NUM_ROOT, Body, joints_of, rest_vector
from stream_dmr.fitting.solver.linear_blend import (
    blend,
    blend_points,
    cholesky_factors,
    skinning_weights,
)
from stream_dmr.fitting.solver.spine import spine_nodes, spine_points
from stream_dmr.geometry import arc_length
from tests.support.shapes import fish_template, seeds

BODY = Body.from_template(fish_template())
JOINTS = np.array([[-0.2, 0.0, 0.0], [0.0, 0.05, 0.0], [0.3, 0.0, 0.1]])
places = st.tuples(*[st.floats(-0.6, 0.6)] * 3).map(np.array)


def weights_at(place: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    W, dE = np.empty(len(JOINTS)), np.empty((len(JOINTS), 6))
    skinning_weights(place, JOINTS, cholesky_factors(weight), W, dE)
    return W, dE


def random_weight(seed: int) -> np.ndarray:
    typical = np.array([1.4, 1.4, 1.4, 0, 0, 0])
    return typical + np.random.default_rng(seed).normal(size=(len(JOINTS), 6))


def random_parameters(seed: int) -> np.ndarray:
    rng, parameters = np.random.default_rng(seed), rest_vector(2)
    joints = joints_of(parameters)
    joints.rotation[:] = rng.normal(size=joints.rotation.shape) * 0.5
    joints.weight[:] += rng.normal(size=joints.weight.shape) * 0.3
    return parameters


@given(place=places, seed=seeds)
def test_skinning_weights_are_those_of_eq_2(place: np.ndarray, seed: int):
    weight = random_weight(seed)
    W, _ = weights_at(place, weight)
    L = cholesky_factors(weight)
    offsets = place - JOINTS
    exponents = [-0.5 * u @ (Lj @ Lj.T) @ u for u, Lj in zip(offsets, L, strict=True)]
    likely = np.exp(np.array(exponents) - max(exponents))
    np.testing.assert_allclose(W, likely / likely.sum(), atol=1e-12)
    np.testing.assert_allclose(W.sum(), 1.0)


@given(place=places, seed=seeds)
def test_slopes_of_the_exponents_are_finite_differences(place: np.ndarray, seed: int):
    weight, step = random_weight(seed), 1e-6
    _, dE = weights_at(place, weight)
    for q in range(6):
        moved = np.zeros((len(JOINTS), 6))
        moved[:, q] = step
        ahead, behind = (cholesky_factors(weight + sign * moved) for sign in (1, -1))
        for j, u in enumerate(place - JOINTS):
            slope = (
                -0.5 * (u @ (ahead[j] @ ahead[j].T) @ u - u @ (behind[j] @ behind[j].T) @ u)
            ) / (2 * step)
            np.testing.assert_allclose(dE[j, q], slope, rtol=1e-5, atol=1e-5)


@given(seed=seeds)
def test_a_blend_is_a_weighted_sum(seed: int):
    rng, out = np.random.default_rng(seed), np.empty(3)
    W, values = rng.random(4), rng.normal(size=(4, 3))
    blend(W, values, out)
    np.testing.assert_allclose(out, W @ values, atol=1e-12)


def test_both_deformations_leave_a_body_at_rest():
    rest = rest_vector(2)
    centered = BODY.points - BODY.places[BODY.place_of[BODY.num_vertices + 1]]
    np.testing.assert_allclose(spine_points(BODY, rest), centered, atol=1e-12)
    np.testing.assert_allclose(blend_points(BODY, rest), BODY.points, atol=1e-12)


@given(seed=seeds)
def test_the_spine_keeps_its_length_however_it_bends(seed: int):
    parameters = random_parameters(seed)
    L = cholesky_factors(joints_of(parameters).weight)
    nodes, slopes = spine_nodes(BODY, parameters, L, False)
    assert len(slopes) == 0
    np.testing.assert_allclose(arc_length(nodes), arc_length(BODY.midline), rtol=1e-12)


@settings(max_examples=10)
@given(seed=seeds)
def test_slopes_of_the_spine_are_finite_differences(seed: int):
    parameters = random_parameters(seed)

    def nodes_of(vector: np.ndarray) -> np.ndarray:
        return spine_nodes(BODY, vector, cholesky_factors(joints_of(vector).weight), False)[0]

    _, slopes = spine_nodes(BODY, parameters, cholesky_factors(joints_of(parameters).weight), True)
    for p in range(len(parameters) - NUM_ROOT):
        step = np.zeros(len(parameters))
        step[NUM_ROOT + p] = 1e-6
        expected = (nodes_of(parameters + step) - nodes_of(parameters - step)) / 2e-6
        np.testing.assert_allclose(slopes[:, :, p], expected, atol=1e-7)
