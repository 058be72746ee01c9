"""Components are OpenCV's own, label by label."""

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.geometry import components

sides = st.integers(1, 60)


@given(sides, sides, st.floats(0, 1), st.integers(0, 999), st.booleans())
def test_labels_and_numbers_are_those_of_opencv_s_default(height, width, share, seed, is_closed):
    mask = (np.random.default_rng(seed).random((height, width)) < share).astype(np.uint8)
    if is_closed:  # larger parts
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    found_count, found_labels, found_stats = components(mask)
    assert found_count == count
    np.testing.assert_array_equal(found_labels, labels)
    np.testing.assert_array_equal(found_stats, stats)
