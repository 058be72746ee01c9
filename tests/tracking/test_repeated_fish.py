"""A fish that was found twice in one picture counts once; neighbours that touch count both."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.camera import Camera
from stream_dmr.detection.detector import Candidate
from stream_dmr.messages import FishCrop
from stream_dmr.tracking.finder import share_inside, with_large_fish, without_repeats
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


class _Shortsighted:
    """Boxes of white rectangles, of those that are longer than 0.7 of the picture only a part."""

    @property
    def refused(self):
        return {}

    def find(self, frame):
        grey = frame.image[..., 0]
        _, _, stats, _ = cv2.connectedComponentsWithStats((grey > 200).astype(np.uint8))
        boxes = np.array([[x, y, x + w, y + h] for x, y, w, h, _ in stats[1:]], np.float64)
        for box in boxes:
            if (box[2:] - box[:2]).max() > 0.7 * max(grey.shape):
                box[2:] = box[:2] + 0.7 * (box[2:] - box[:2])  # its tail is missing
        return [Candidate(bbox_xyxy_px=box, score=0.8) for box in boxes]


@given(st.integers(1, 60), st.integers(100, 310), st.booleans())
def test_a_fish_that_fills_the_picture_is_seen_whole(left, length, has_neighbour):
    picture = np.zeros((200, 320, 3), np.uint8)
    right = min(left + length, 318)
    picture[80:120, left:right] = 255
    if has_neighbour:
        picture[150:160, 10:40] = 255
    frame = frame_of(picture)
    found = with_large_fish(_Shortsighted().find(frame), _Shortsighted(), frame)
    boxes = sorted(one.bbox_xyxy_px.tolist() for one in found)
    expected = [[left, 80, right, 120]] + [[10, 150, 40, 160]] * has_neighbour
    np.testing.assert_allclose(boxes, sorted(expected))
