"""What counts has moved and looks like a fish, or was found by somebody."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.detector import Candidate
from stream_dmr.tracking.confirmation import FishEvidence

SIZE_PX = 60.0


def candidate(
    x: float | None = 0.0, *, looks: float | None = None, camera_x: float = 0.0
) -> Candidate:
    """At x in the scene, before a camera that has moved by `camera_x`."""
    place = None if x is None else np.array([x, 150.0])
    left, top = (x or 0.0) - camera_x - SIZE_PX / 2, 140.0
    box = np.array([left, top, left + SIZE_PX, top + 20.0])
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


@pytest.mark.parametrize(
    ("speed", "has_moved"),
    [
        (0.0, False),  # a rock at the depth of the scene
        (4.0, False),  # a rock before it, or behind it
        (10.0, True),  # a fish that the camera follows
        (-10.0, True),
    ],
)
def test_what_a_panning_camera_passes_has_not_moved(speed, has_moved):
    frames = [candidate(200 + speed * i, camera_x=10.0 * i) for i in range(30)]
    assert evidence_of(*frames).has_moved == has_moved


def test_a_network_s_box_that_jumps_has_not_moved():
    """Of a tree it now sees the whole and now a half; an outline that moves its middle has."""

    def box(left: float, right: float, *, is_outlined: bool) -> Candidate:
        outline = np.ones((20, round(right - left)), bool) if is_outlined else None
        return Candidate(
            bbox_xyxy_px=np.array([left, 0.0, right, 20.0], np.float64),
            score=0.4,
            foreground=outline,
            place_px=np.array([(left + right) / 2, 10.0]),
            looks=0.4,
        )

    def has_moved(right: float, left: float, *, is_outlined: bool) -> bool:
        first = box(0, 60, is_outlined=is_outlined)
        return evidence_of(first, box(left, right, is_outlined=is_outlined)).has_moved

    assert not has_moved(60, 32, is_outlined=False)
    assert has_moved(60, 32, is_outlined=True)
    assert has_moved(92, 32, is_outlined=False)


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


@given(st.integers(10, 300), st.integers(4, 30))
def test_what_looks_like_a_fish_now_and_then_for_hours_is_none(num_frames, every):
    looks = [0.9 if n % every == 0 else 0.3 for n in range(num_frames)]
    evidence = evidence_of(*(candidate(looks=one) for one in looks))
    is_rare = every > 4 or looks.count(0.9) < 4
    assert evidence.has_moved != is_rare


def test_what_moves_for_hours_must_look_like_a_fish_in_a_tenth_of_its_frames():
    seldom = [candidate(looks=0.9 if n % 20 == 0 else 0.0) for n in range(200)]
    often = [candidate(looks=0.9 if n % 9 == 0 else 0.0) for n in range(200)]
    assert not evidence_of(*seldom).looks_like_a_fish(2)
    assert evidence_of(*often).looks_like_a_fish(2)


def test_what_may_not_count_is_cut_out_at_first_and_then_in_a_quarter_of_its_frames():
    due = [n for n in range(1, 21) if evidence_of(*[candidate()] * n).is_due]
    assert due == [1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20]


def test_closer_looks_count_as_looks_and_are_counted():
    evidence = evidence_of(*[candidate(looks=0.0)] * 5)
    for looks in (0.9, 0.0, 0.9):
        assert not evidence.looks_like_a_fish(2)
        evidence.add_closer_look(looks)
    assert evidence.looks_like_a_fish(2)
    assert evidence.closer_looks == 3
