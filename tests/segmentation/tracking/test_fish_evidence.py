"""What counts has moved and looks like a fish, or was found by somebody."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.segmentation.tracking.fish_evidence import FishEvidence

SIZE_PX = 60.0


def candidate(x: float | None = 0.0, *, looks: float | None = None) -> Candidate:
    box = np.array([10.0, 20.0, 70.0, 40.0])
    place = None if x is None else np.array([x, 150.0])
    return Candidate(bbox_xyxy_px=box, score=1.0, place_px=place, looks=looks)


def evidence_of(*candidates: Candidate) -> FishEvidence:
    evidence = FishEvidence(candidates[0], SIZE_PX)
    for one in candidates[1:]:
        evidence.add(one, SIZE_PX)
    return evidence


@pytest.mark.parametrize(
    ("place", "has_moved", "went_far"),
    [
        (lambda i: 200.0, False, False),
        (lambda i: 200.0 + 0.5 * i, False, False),
        (lambda i: 200.0 + 12 * np.sin(i), False, False),  # a plant sways
        (lambda i: 200.0 + 20 * np.sin(i), True, False),
        (lambda i: 200.0 + 4.0 * i, True, True),
    ],
)
def test_it_is_the_greatest_distance_from_the_first_place_that_counts(place, has_moved, went_far):
    evidence = evidence_of(*(candidate(place(i)) for i in range(12)))
    assert (evidence.has_moved, evidence.went_far) == (has_moved, went_far)


def test_what_somebody_found_need_not_move_nor_look_like_a_fish():
    evidence = evidence_of(*[candidate(None)] * 3)
    assert evidence.has_moved
    assert evidence.went_far
    assert evidence.looks_like_a_fish(9)


def test_what_surely_looks_like_a_fish_need_not_move():
    assert not evidence_of(*[candidate(looks=0.9)] * 3).has_moved
    assert evidence_of(*[candidate(looks=0.9)] * 4).went_far
    assert not evidence_of(*[candidate(looks=0.5)] * 40).has_moved


@given(st.lists(st.floats(0, 0.1), min_size=1, max_size=30), st.integers(1, 5))
def test_what_never_looks_like_a_fish_is_none(looks, min_frames):
    evidence = evidence_of(*(candidate(looks=one) for one in looks))
    assert not evidence.looks_like_a_fish(min_frames)
    assert evidence.looks_like_a_fish(0)


def test_closer_looks_count_as_looks_and_are_counted():
    evidence = evidence_of(*[candidate(looks=0.0)] * 5)
    for looks in (0.9, 0.0, 0.9):
        assert not evidence.looks_like_a_fish(2)
        evidence.add_closer_look(looks)
    assert evidence.looks_like_a_fish(2)
    assert evidence.closer_looks == 3
