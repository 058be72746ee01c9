"""Boxes rounded to whole pixels, and how much two have in common."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.geometry import box_iou, whole_pixels

places = st.floats(0, 1000)


@given(places, places, st.floats(0, 50), st.floats(0, 50))
def test_whole_pixels_are_the_nearest_box_of_at_least_a_pixel(
    x: float, y: float, w: float, h: float
):
    x0, y0, x1, y1 = whole_pixels(np.array([x, y, x + w, y + h]))
    assert abs(x0 - x) <= 0.5
    assert abs(y0 - y) <= 0.5
    assert x1 - x0 >= 1
    assert y1 - y0 >= 1
    assert abs(x1 - x - w) <= max(0.5, 1 - w + 0.5)
    assert abs(y1 - y - h) <= max(0.5, 1 - h + 0.5)


boxes = st.tuples(*[st.floats(0, 50)] * 2, *[st.floats(1, 50)] * 2).map(
    lambda b: np.array([b[0], b[1], b[0] + b[2], b[1] + b[3]])
)


@given(boxes, boxes)
def test_iou_is_symmetric_from_0_to_1_and_1_for_the_same_box(one: np.ndarray, other: np.ndarray):
    assert 0 <= box_iou(one, other) <= 1
    assert box_iou(one, other) == pytest.approx(box_iou(other, one))
    assert box_iou(one, one) == pytest.approx(1)
