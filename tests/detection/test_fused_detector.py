"""Motion and looks find each fish once, and every candidate has its place in the scene."""

from dataclasses import replace
from typing import ClassVar

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.detector import Candidate
from stream_dmr.detection.fused_detector import FusedDetector, fuse
from stream_dmr.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.detection.picture_views import brightened, look_closer
from stream_dmr.geometry import fraction_inside
from stream_dmr.messages import Frame
from tests.support.frames import frame_of

STILL = Candidate(bbox_xyxy_px=np.array([20.0, 20.0, 80.0, 60.0]), score=0.9)


class Looks:
    """Finds everything where it is; also the shape that moves."""

    def __init__(self, *found: Candidate) -> None:
        self.refused: dict[str, int] = {}
        self._found = found

    def find(self, frame: Frame) -> list[Candidate]:
        return list(self._found)


def frame(i: int) -> Frame:
    image = np.full((240, 320, 3), 60, np.uint8)
    image[150:180, 100 + 10 * i : 170 + 10 * i] = 220
    return frame_of(image, i)


def is_still(one: Candidate) -> bool:
    return np.array_equal(one.bbox_xyxy_px, STILL.bbox_xyxy_px)


def test_what_hangs_still_is_found_by_its_looks_and_candidates_have_places():
    detector = FusedDetector(MotionDetector(MotionSettings()), Looks(STILL))
    found = [detector.find(frame(i % 8)) for i in range(1, 40)]
    assert all(sum(is_still(one) for one in some) == 1 for some in found)
    assert any(len(some) == 2 for some in found)
    for one in (one for some in found for one in some):
        middle = one.bbox_xyxy_px.reshape(2, 2).mean(axis=0)
        np.testing.assert_allclose(one.place_px, middle, atol=1)  # the camera is at rest


def test_it_is_said_how_much_everything_looks_like_a_fish():
    detector = FusedDetector(MotionDetector(MotionSettings()), Looks(replace(STILL, score=0.7)))
    found = [detector.find(frame(i)) for i in range(8)][-1]
    assert {is_still(one): one.looks for one in found} == {True: 0.7, False: 0.0}


def test_a_shape_that_moves_is_found_once():
    box = np.array([140.0, 150.0, 210.0, 180.0])
    both = Looks(STILL, Candidate(bbox_xyxy_px=box, score=0.9))
    detector = FusedDetector(MotionDetector(MotionSettings()), both)
    found = [detector.find(frame(i)) for i in range(5)][-1]
    assert sorted(is_still(one) for one in found) == [False, True]


@given(level=st.integers(0, 255))
def test_only_dark_pictures_are_brightened(level: int):
    ramp = np.linspace(0, 255, 320).astype(np.uint8)
    image = np.full((240, 320, 3), level, np.uint8)
    image[:40] = ramp[:, None]
    shown = brightened(frame_of(image, 1)).image
    assert level < 77 or np.array_equal(shown, image)  # 0.3 of 255
    assert (shown >= image).all()
    assert (np.diff(shown[0, :, 0].astype(int)) >= 0).all()
    assert shown.min() == 0
    assert shown.max() == 255
    if 23 <= level < 77:  # the root is enough for these
        assert abs(int(shown[-1, 0, 0]) - 0.3 * 255) <= 1


class LargeAndBright:
    """Finds what is bright and at least a twentieth of the picture wide, as networks do."""

    refused: ClassVar[dict[str, int]] = {}

    def find(self, frame: Frame) -> list[Candidate]:
        x, y, width, height = cv2.boundingRect((frame.image[..., 0] > 128).astype(np.uint8))
        if width < 0.05 * frame.image.shape[1]:
            return []
        return [Candidate(bbox_xyxy_px=np.array([x, y, x + width, y + height], float), score=0.8)]


@given(st.integers(0, 1240), st.integers(0, 920), st.integers(16, 40))
def test_small_fish_are_told_from_nearby_wherever_they_are(x: int, y: int, side: int):
    image = np.zeros((960, 1280, 3), np.uint8)
    image[y : y + side, x : x + side] = 255
    box = np.array([x, y, x + side, y + side], np.float64)
    assert LargeAndBright().find(frame_of(image)) == []
    assert look_closer(LargeAndBright(), frame_of(image), box) == pytest.approx(0.8)
    beside = box + (100 if x < 640 else -100)
    assert look_closer(LargeAndBright(), frame_of(image), beside) == 0.0


class Marked:
    """Finds the white box of a picture."""

    refused: ClassVar[dict[str, int]] = {}

    def find(self, frame: Frame) -> list[Candidate]:
        x, y, w, h = cv2.boundingRect(frame.image[..., 0])
        return [Candidate(bbox_xyxy_px=np.array([x, y, x + w, y + h], float), score=1.0)]


@given(
    st.tuples(st.integers(20, 900), st.integers(20, 900)), st.tuples(*[st.floats(0.01, 0.99)] * 4)
)
def test_a_closer_look_shows_the_box_anywhere_in_pictures_of_any_size(
    shape: tuple[int, int], corners: tuple[float, float, float, float]
):
    """Upright and turned: else the box would be found elsewhere, with a score of 0."""
    height, width = shape
    x0, x1 = sorted(1 + int(share * (width - 3)) for share in corners[:2])
    y0, y1 = sorted(1 + int(share * (height - 3)) for share in corners[2:])
    image = np.zeros((height, width, 3), np.uint8)
    image[y0 : y1 + 1, x0 : x1 + 1] = 255
    box = np.array([x0, y0, x1 + 1, y1 + 1], np.float64)
    assert look_closer(Marked(), frame_of(image), box) == 1.0


def at(x0: float, y0: float, x1: float, y1: float) -> Candidate:
    return Candidate(bbox_xyxy_px=np.array([x0, y0, x1, y1], np.float64), score=0.9)


def test_the_outline_of_what_moves_is_kept_where_a_fish_is_seen_as_well():
    fish, moving, other = at(10, 10, 210, 90), at(20, 5, 200, 85), at(300, 10, 400, 50)
    assert fuse([moving], [fish, other]) == [moving, other]


boxes = st.lists(
    st.tuples(st.floats(0, 300), st.floats(0, 200), st.floats(5, 200), st.floats(5, 200)),
    max_size=5,
)


@given(boxes, boxes)
def test_nothing_is_invented_and_nothing_seen_is_lost(moving, seen):
    moves, looks = ([at(x, y, x + w, y + h) for x, y, w, h in some] for some in (moving, seen))
    found = fuse(moves, looks)
    assert all(one in [*moves, *looks] for one in found)
    for fish in looks:  # it is there, or something in its place
        inside = (fraction_inside(fish.bbox_xyxy_px, one.bbox_xyxy_px) for one in found)
        assert max(inside, default=0.0) > 0.29
    assert fuse(moves, []) == moves


def outlined(x0: int, y0: int, x1: int, y1: int) -> Candidate:
    return replace(at(x0, y0, x1, y1), foreground=np.ones((y1 - y0, x1 - x0), bool))


UPPER, LOWER = outlined(100, 100, 160, 180), outlined(90, 190, 170, 300)


def test_pieces_in_the_box_of_one_fish_are_that_fish():
    elsewhere = outlined(400, 100, 450, 150)
    kept, whole = fuse([UPPER, elsewhere, LOWER], [at(85, 95, 175, 305)])
    assert kept is elsewhere
    np.testing.assert_array_equal(whole.bbox_xyxy_px, [90, 100, 170, 300])
    rows, columns = np.nonzero(whole.foreground)
    assert len(rows) == 60 * 80 + 80 * 110
    assert not whole.foreground[80:90].any()
    assert set(columns[rows < 80]) == set(range(10, 70))


@pytest.mark.parametrize(
    "seen",
    [
        [],
        [replace(at(85, 95, 175, 305), score=0.5)],  # perhaps a fish
        [at(0, 0, 400, 600)],  # much larger than both
        [at(85, 95, 175, 305), at(90, 190, 170, 300)],  # one is a fish of its own
    ],
)
def test_pieces_stay_apart_where_no_box_says_that_they_are_one_fish(seen):
    assert fuse([UPPER, LOWER], seen)[:2] == [UPPER, LOWER]
