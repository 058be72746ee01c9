"""What the tracker measures of a candidate."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.detector import Candidate
from stream_dmr.geometry import fraction_inside, oriented_extent
from stream_dmr.tracking.observation import Observation, colours_of, dissimilarity
from tests.support.frames import ellipse_mask

edges = st.floats(0, 100)
boxes = st.tuples(edges, edges, st.floats(1, 50), st.floats(1, 50)).map(
    lambda b: np.array([b[0], b[1], b[0] + b[2], b[1] + b[3]])
)


def test_area_length_and_colour_are_those_of_the_silhouette():
    mask = ellipse_mask(size=(300, 200), center=(150, 100), axes=(60, 15), angle=30.0)
    image = np.full((200, 300, 3), 20, np.uint8)
    image[mask > 0] = (50, 100, 150)
    x, y, w, h = cv2.boundingRect(mask)
    candidate = Candidate(
        bbox_xyxy_px=np.array([x, y, x + w, y + h], np.float64),
        score=1.0,
        foreground=mask[y : y + h, x : x + w] > 0,
    )
    observation = Observation(image, candidate)
    assert observation.area == mask.sum() == pytest.approx(np.pi * 60 * 15, rel=0.05)
    assert observation.length == pytest.approx(120, abs=2)
    alone = colours_of(np.full((9, 9, 3), (50, 100, 150), np.uint8), np.ones((9, 9), bool))
    assert dissimilarity(observation.colours, alone) == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(observation.center, [150, 100], atol=1)
    assert not observation.touches_border
    assert not observation.is_piece


@pytest.mark.parametrize(("right", "is_cut"), [(96.0, True), (90.0, False)])
def test_a_box_that_nearly_reaches_the_edge_reaches_it(right: float, is_cut: bool):
    """A network draws a fish that is cut off to 8 % or so; a silhouette is what it is."""
    image, box = np.zeros((100, 100, 3), np.uint8), np.array([20.0, 20, right, 80])
    seen = Candidate(bbox_xyxy_px=box, score=1.0)
    assert Observation(image, seen).touches_border == is_cut
    outlined = replace(seen, foreground=np.ones((60, round(right) - 20), bool))
    assert not Observation(image, outlined).touches_border


def test_a_single_pixel_has_a_length_to_divide_by():
    speck = Candidate(
        bbox_xyxy_px=np.array([5.0, 5, 6, 6]), score=1.0, foreground=np.ones((1, 1), bool)
    )
    observation = Observation(np.zeros((9, 9, 3), np.uint8), speck)
    assert (observation.area, observation.length) == (1.0, 1.0)


def test_a_piece_knows_the_box_of_the_whole():
    image = np.zeros((100, 100, 3), np.uint8)
    whole = Candidate(bbox_xyxy_px=np.array([20.0, 20, 80, 80]), score=1.0)
    piece = Candidate(bbox_xyxy_px=np.array([20.0, 20, 50, 80]), score=1.0)
    observation = Observation(image, piece, whole=whole)
    assert observation.is_piece
    np.testing.assert_array_equal(observation.outer_box, whole.bbox_xyxy_px)
    np.testing.assert_array_equal(observation.box, piece.bbox_xyxy_px)


@given(boxes, boxes)
def test_the_common_area_of_two_boxes_is_the_same_from_both(one: np.ndarray, other: np.ndarray):
    areas = [np.prod(box[2:] - box[:2]) for box in (one, other)]
    share, back = fraction_inside(one, other), fraction_inside(other, one)
    assert 0 <= share <= 1
    assert share * areas[0] == pytest.approx(back * areas[1])
    assert fraction_inside(one, one) == pytest.approx(1)


@given(st.integers(20, 60), st.integers(4, 19), st.floats(0, 180))
def test_width_and_length_do_not_depend_on_the_angle(long: int, short: int, angle: float):
    mask = ellipse_mask(size=(200, 200), center=(100, 100), axes=(long, short), angle=angle)
    width_px, length_px = oriented_extent(mask > 0)
    assert length_px == pytest.approx(2 * long, abs=3)
    assert width_px == pytest.approx(2 * short, abs=3)


def test_an_empty_shape_has_no_extent():
    assert oriented_extent(np.zeros((5, 5), bool)) == (0.0, 0.0)
