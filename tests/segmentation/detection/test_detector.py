"""Boxes rounded to whole pixels."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.segmentation.detection.detector import whole_pixels

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
