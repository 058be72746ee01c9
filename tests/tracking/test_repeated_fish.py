"""A fish that was found twice in one picture counts once; neighbours that touch count both."""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.camera import Camera
from stream_dmr.detection.detector import Candidate
from stream_dmr.detection.picture_views import find_both_ways, find_in_still
from stream_dmr.messages import FishCrop
from stream_dmr.tracking.finder import goes_under, share_inside, without_repeats
from tests.support.frames import frame_of
from tests.support.given_masks import crop_of

CAMERA = Camera.nominal(width=640, height=480)


def crop_with(x0: int, x1: int, y0: int = 200, y1: int = 300) -> FishCrop:
    """A fish that fills a rectangle of the frame."""
    mask = np.zeros((480, 640), bool)
    mask[y0:y1, x0:x1] = True
    return crop_of(mask, CAMERA, box=[x0, y0, x1, y1])


@given(st.integers(100, 300), st.integers(40, 250), st.integers(100, 300), st.integers(40, 250))
@settings(max_examples=20, deadline=None)
def test_shares_are_those_of_the_rectangles(x: int, w: int, other_x: int, other_w: int):
    both = max(0, min(x + w, other_x + other_w) - max(x, other_x))
    found = share_inside(crop_with(x, x + w), crop_with(other_x, other_x + other_w))
    assert found == pytest.approx(both / w, abs=0.05)


def test_what_lies_in_a_fish_of_a_higher_score_is_no_fish_of_its_own():
    whole, fin, without_tail = (
        crop_with(100, 400),
        crop_with(250, 300, 260, 300),
        crop_with(95, 350),
    )
    neighbour = crop_with(390, 560)
    crops = {3: whole, 4: fin, 7: without_tail, 9: neighbour}
    assert without_repeats(crops, {3: 0.8, 4: 0.6, 7: 0.5, 9: 0.4}) == [3, 9]
    assert without_repeats(crops, {3: 0.5, 4: 0.6, 7: 0.8, 9: 0.4}) == [7, 9]
    # A fin does not hide its fish.
    assert without_repeats({3: whole, 4: fin}, {3: 0.5, 4: 0.6}) == [3, 4]


def test_a_box_around_two_fish_hides_neither():
    crops = {1: crop_with(100, 300), 2: crop_with(310, 500), 3: crop_with(100, 500)}
    assert without_repeats(crops, {1: 0.7, 2: 0.6, 3: 0.5}) == [1, 2, 3]


def test_an_empty_mask_lies_nowhere():
    empty = crop_with(100, 300)
    empty = replace(empty, mask=np.zeros_like(empty.mask))
    assert share_inside(empty, crop_with(100, 300)) == share_inside(crop_with(1, 9), empty) == 0


@pytest.mark.parametrize(
    ("other", "is_under"),
    [
        ((400, 470, 80, 400), True),  # across its tail
        ((30, 101, 80, 400), True),  # across its head
        ((420, 490, 80, 400), False),  # water between
        ((100, 400, 240, 280), False),  # side by side
        ((380, 560, 250, 280), False),  # past a corner of its tail
    ],
)
def test_a_fish_goes_under_another_one_at_which_its_end_ends(
    other: tuple[int, int, int, int], is_under: bool
):
    fish = crop_with(100, 400, 200, 240)
    assert goes_under(fish, [crop_with(10, 60, 20, 40), crop_with(*other)]) == is_under


def test_a_fish_that_lies_upon_another_one_does_not_go_under_it():
    whole = np.zeros((480, 640), bool)
    whole[80:400, 350:450] = True
    whole[200:240, :400] = False
    below = crop_of(whole, CAMERA, box=[350, 80, 450, 400])
    assert not goes_under(crop_with(100, 400, 200, 240), [below])
    assert not goes_under(below, [crop_with(100, 400, 200, 240)])
    empty = replace(below, mask=np.zeros_like(below.mask))
    assert not goes_under(empty, [below])
    assert not goes_under(below, [empty])


class _Nearsighted:
    """Boxes of white rectangles; of long ones only a part, of short ones none.

    Long and short: beside the picture that it is shown.
    """

    @property
    def refused(self):
        return {}

    def find(self, frame):
        grey = frame.image[..., 0]
        _, _, stats, _ = cv2.connectedComponentsWithStats((grey > 200).astype(np.uint8))
        found = []
        for x, y, w, h, _ in stats[1:]:
            share = max(w, h) / max(grey.shape)
            seen = 0.7 if share > 0.7 else 1.0  # its tail is missing
            box = np.array([x, y, x + seen * w, y + seen * h], np.float64)
            if share > 0.12:
                found.append(Candidate(bbox_xyxy_px=box, score=0.8))
        return found


@given(st.integers(1, 60), st.integers(100, 310), st.sampled_from([0, 30, 60]))
def test_large_and_small_fish_of_a_still_are_found_whole_and_once(left, length, neighbour):
    picture = np.zeros((200, 320, 3), np.uint8)
    right = min(left + length, 318)
    picture[80:120, left:right] = 255
    picture[150:160, 10 : 10 + neighbour] = 255
    found = find_in_still(_Nearsighted(), frame_of(picture))
    boxes = sorted(one.bbox_xyxy_px.tolist() for one in found)
    expected = [[left, 80, right, 120]] + [[10, 150, 10 + neighbour, 160]] * (neighbour > 0)
    np.testing.assert_allclose(boxes, sorted(expected))


class _LeftEyed:
    """Boxes of white rectangles in the left half of a picture, with a score of 0.9."""

    refused: Mapping[str, int] = {}

    def find(self, frame):
        image = frame.image.copy()
        image[:, image.shape[1] // 2 :] = 0
        return _Boxes(0.9).find(frame_of(image))


@given(st.integers(0, 60), st.integers(20, 100))
def test_what_only_one_of_two_mirrored_pictures_shows_has_half_of_its_score(left, length):
    picture = np.zeros((200, 320, 3), np.uint8)
    picture[80:120, left : left + length] = 255
    seen = find_both_ways(_LeftEyed(), frame_of(picture))
    mirrored = find_both_ways(_LeftEyed(), frame_of(picture[:, ::-1]))
    for candidate, other in zip(seen, mirrored, strict=True):
        x0, y0, x1, y1 = candidate.bbox_xyxy_px
        np.testing.assert_allclose(other.bbox_xyxy_px, [320 - x1, y0, 320 - x0, y1])
        assert candidate.score == other.score == pytest.approx(0.45)
    [both] = find_both_ways(_Boxes(0.9), frame_of(picture))
    np.testing.assert_allclose(both.bbox_xyxy_px, [left, 80, left + length, 120])
    assert both.score == pytest.approx(0.9)


class _Boxes:
    """The boxes of all white rectangles, with one score."""

    refused: Mapping[str, int] = {}

    def __init__(self, score: float) -> None:
        self._score = score

    def find(self, frame):
        white = (frame.image[..., 0] > 200).astype(np.uint8)
        _, _, stats, _ = cv2.connectedComponentsWithStats(white)
        boxes = [np.array([x, y, x + w, y + h], np.float64) for x, y, w, h, _ in stats[1:]]
        return [Candidate(bbox_xyxy_px=box, score=self._score) for box in boxes]


@given(st.sampled_from([0, 400]), st.integers(16, 60), st.sampled_from([0.4, 0.8]))
def test_dirt_beside_a_fish_of_ten_times_its_length_or_in_a_wide_picture_is_none(fish, dirt, score):
    picture = np.zeros((300, 500, 3), np.uint8)
    picture[50:150, 20 : 20 + fish] = 255
    picture[200:215, 100 : 100 + dirt] = 255
    found = find_in_still(_Boxes(score), frame_of(picture))
    lengths = sorted(float(one.bbox_xyxy_px[2] - one.bbox_xyxy_px[0]) for one in found)
    is_dirt = dirt < 0.05 * 500 or (fish > 0 and score >= 0.5 and dirt < 0.1 * fish)
    assert lengths == [dirt] * (not is_dirt) + [fish] * (fish > 0)


def test_a_still_may_be_one_pixel_high():
    assert find_in_still(_Boxes(0.8), frame_of(np.zeros((1, 5000, 3), np.uint8))) == []


class _Outlines(_Boxes):
    """The same, with silhouettes; remembers the longest side of a picture that it was shown."""

    longest_px = 0

    def find(self, frame):
        self.longest_px = max(self.longest_px, *frame.image.shape)
        found = super().find(frame)
        sizes = [np.ptp(one.bbox_xyxy_px.reshape(2, 2), axis=0).astype(int) for one in found]
        return [
            replace(one, foreground=np.ones((height, width), bool))
            for one, (width, height) in zip(found, sizes, strict=True)
        ]


@given(st.integers(0, 1000), st.integers(0, 1000), st.integers(300, 3000))
@settings(max_examples=2)  # a picture of ten megapixels each
def test_the_full_size_of_a_telephones_picture_is_looked_at_in_part_only(left, top, length):
    picture = np.zeros((2500, 4100, 3), np.uint8)
    picture[top : top + length // 3, left : left + length] = 255
    detector = _Outlines(0.8)
    [fish] = find_in_still(detector, frame_of(picture))
    expected = [left, top, left + length, top + length // 3]
    np.testing.assert_allclose(fish.bbox_xyxy_px, expected, atol=4)
    assert fish.score == pytest.approx(0.8)
    assert fish.foreground is None  # those of two views differ, and neither fits a mean box
    assert detector.longest_px < 3100
