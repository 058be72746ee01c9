"""The paper's solver: never worse than its start, repeatable, and it says why it ended."""

import numpy as np
from hypothesis import given, settings

from stream_dmr.fitting.body import LOG_SIZE, ROOT_TRANSLATION
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.paper.adam import AdamSolver
from stream_dmr.fitting.target import Solver, Target, rank
from tests.support.shapes import crop_of, fish_rig, fish_template, pose, seeds

TEMPLATE, RIG = fish_template(), fish_rig()
QUICK = AdamSolver(TEMPLATE, FitMeshSettings(adam_iterations=12))


def posed(seed: int) -> tuple[Target, np.ndarray]:
    rng = np.random.default_rng(seed)
    flat = pose(rng, in_plane_rad=rng.uniform(-3, 3))
    crop = crop_of(flat, RIG, size=48)
    return Target.from_crop(crop, plane_normal=np.array([0.0, 0.0, 1.0])), flat[0].numpy()


def test_it_is_a_solver():
    assert isinstance(QUICK, Solver)


@settings(max_examples=3)
@given(seed=seeds)
def test_a_descent_ends_no_higher_than_it_began(seed: int):
    target, truth = posed(seed)
    start = truth.copy()
    start[ROOT_TRANSLATION] += 0.05
    start[LOG_SIZE] += 0.1
    none = AdamSolver(TEMPLATE, FitMeshSettings(adam_iterations=1)).refine(target, start)
    some = QUICK.refine(target, start)
    np.testing.assert_array_equal(none.parameters, start)
    assert some.loss <= none.loss
    assert some.iterations <= 12
    assert some.converged or some.stop_reason == "iterations used up"


def test_equal_starts_give_equal_bits():
    target, truth = posed(1)
    one, other = (QUICK.refine(target, truth) for _ in range(2))
    assert one.parameters.tobytes() == other.parameters.tobytes()
    assert one.loss == other.loss


def test_a_search_takes_the_best_of_its_starts():
    target, truth = posed(2)
    far = truth.copy()
    far[ROOT_TRANSLATION] += 0.4
    found = QUICK.search(target, np.stack([far, truth, far]))
    assert rank(target, found) <= rank(target, QUICK.refine(target, truth)) + 1e-3
