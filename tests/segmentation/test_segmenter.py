"""What a segmenter finds, in a crop of another size than the picture that it saw."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import FishEnds
from stream_dmr.segmentation.segmenter import SegmentedFish


def found(size: int, left: int, right: int) -> SegmentedFish:
    """A fish between two columns, its head in the middle of the left one."""
    probability = np.zeros((size, size), np.float32)
    probability[:, left:right] = 1
    ends = FishEnds(
        head_px=np.array([float(left), size / 2]),
        tail_px=np.array([float(right - 1), size / 2]),
        confidence=0.9,
    )
    return SegmentedFish(probability=probability, ends=ends)


@given(st.integers(0, 30), st.integers(1, 30), st.integers(2, 4))
def test_pixel_edges_stay_where_they_are(left, width, times):
    one = found(64, left, left + width)
    larger = one.resized(64 * times)
    assert larger.probability.sum() == pytest.approx(times**2 * one.probability.sum(), rel=0.02)
    # The middle of a pixel is the middle of the pixels that it became.
    middle = times * left + (times - 1) / 2
    assert larger.ends.head_px[0] == pytest.approx(middle)
    back = larger.resized(64)
    np.testing.assert_allclose(back.probability, one.probability, atol=0.3)
    np.testing.assert_allclose(back.ends.tail_px, one.ends.tail_px)


def test_half_covered_pixels_are_half_a_fish():
    smaller = found(64, 11, 40).resized(32)
    np.testing.assert_allclose(smaller.probability[:, 5], 0.5)
    assert smaller.probability.max() == 1


def test_the_same_size_changes_nothing():
    one = found(64, 7, 22)
    np.testing.assert_array_equal(one.resized(64).probability, one.probability)
