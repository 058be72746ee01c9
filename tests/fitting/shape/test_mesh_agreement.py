"""Shapes learnt from fish against the mesh that was given for them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.fitting.shape.candidates import (
    CandidateShape,
    CandidateShapes,
    LengthShift,
    is_like_mesh,
    not_like_mesh,
)
from stream_dmr.fitting.shape.space import BREADTH, NUM_COEFFICIENTS, THICKNESS, form_precision

SURE = np.zeros((NUM_COEFFICIENTS, NUM_COEFFICIENTS))
UNSURE = np.linalg.inv(form_precision())


def stock(breadth: float, *, covariance: np.ndarray = SURE, thickness: float = 0.0):
    coefficients = np.zeros(NUM_COEFFICIENTS)
    coefficients[BREADTH], coefficients[THICKNESS] = breadth, thickness
    return CandidateShape("mine", coefficients, covariance, 1.0)


@given(breadth=st.floats(-0.07, 0.07), thickness=st.floats(-0.5, 0.5))
def test_a_mesh_is_believed_within_some_percent(breadth: float, thickness: float):
    assert is_like_mesh(stock(breadth, thickness=thickness))


@given(breadth=st.floats(0.09, 2.0), sign=st.sampled_from([-1, 1]))
def test_and_not_beyond(breadth: float, sign: int):
    assert not is_like_mesh(stock(sign * breadth))


def test_what_is_not_known_of_few_fish_is_allowed_for():
    assert is_like_mesh(stock(0.12, covariance=UNSURE))
    assert not is_like_mesh(stock(0.12))


def test_but_not_what_is_not_known_of_a_mixed_catch():
    assert not is_like_mesh(stock(0.19, covariance=9 * UNSURE))
    assert is_like_mesh(stock(0.14, covariance=9 * UNSURE))


def test_a_mesh_of_the_same_breadth_and_another_outline_is_not_believed():
    one = stock(0.0)
    one.coefficients[BREADTH] = np.tile(np.linspace(0.6, -0.6, 12), 2)
    assert abs(one.coefficients[BREADTH].mean()) < 1e-12
    assert not is_like_mesh(one)


@given(log_ratio=st.floats(-0.039, 0.039), num_fish=st.integers(1, 60))
def test_lengths_may_move_by_some_percent(log_ratio: float, num_fish: int):
    assert LengthShift(log_ratio, 0.0, num_fish).off < 1


def test_and_as_far_as_they_are_uncertain_which_is_less_far_for_many_fish():
    assert LengthShift(-0.09, 0.1, 1).off < 1 < LengthShift(-0.09, 0.1, 12).off
    assert LengthShift(-0.07, 0.1, 1000).off < 1 < LengthShift(-0.11, 0.1, 1).off


def test_it_is_said_what_the_mesh_does_to_lengths():
    shapes = CandidateShapes.of([stock(0.0)], are_learnt=True)
    assert not_like_mesh(shapes, shapes, LengthShift(-0.1)).endswith("; by it they are 11% longer")
    assert not_like_mesh(shapes, shapes, LengthShift(0.1)).endswith("; by it they are 10% shorter")
    assert "by it" not in not_like_mesh(shapes, shapes)
