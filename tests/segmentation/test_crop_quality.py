"""Quality facts of a crop."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.segmentation.crop_geometry import glare, sharpness, touches_border

MASK = np.zeros((64, 64), bool)
MASK[10:50, 10:50] = True


@given(st.integers(0, 20), st.integers(0, 20), st.integers(0, 20), st.integers(0, 20))
def test_a_box_within_a_pixel_of_any_edge_touches_the_border(
    left: int, top: int, right: int, bottom: int
):
    extent = np.array([left, top, 200 - right, 100 - bottom], np.float64)
    touches = touches_border(extent, shape=(100, 200))
    assert touches == (min(left, top, right, bottom) <= 1)


@given(st.integers(0, 200), st.floats(0.2, 60))
def test_a_mask_of_large_pixels_touches_the_edge_if_no_row_of_them_is_between(
    gap: int, pixel_px: float
):
    """Its box has the centers of its pixels: half of one lies beyond it."""
    extent = np.array([1000, 1000, 4000 - gap, 2000], np.float64)
    touches = touches_border(extent, shape=(3000, 4000), pixel_px=pixel_px)
    assert touches == (gap <= 1 or gap + 0.5 <= pixel_px)


def test_an_empty_mask_touches_nothing():
    assert not touches_border(None, shape=(100, 200))


@given(st.floats(0, 1))
def test_glare_is_the_overexposed_fraction_of_the_mask(share: float):
    image = np.full((64, 64, 3), 255, np.uint8)  # overexposed outside the mask as well
    rows = round(40 * share)
    image[10 + rows : 50, 10:50] = (255, 255, 240)  # one channel below the limit
    assert glare(image, MASK) == pytest.approx(rows / 40)


@given(st.floats(0.8, 3))
def test_blur_lowers_sharpness(sigma_px: float):
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    blurred = cv2.GaussianBlur(image, (0, 0), sigma_px)
    assert 0 < sharpness(blurred, MASK) < 0.5 * sharpness(image, MASK)


def test_an_empty_mask_has_neither_glare_nor_sharpness():
    image = np.full((64, 64, 3), 255, np.uint8)
    assert (glare(image, ~MASK & MASK), sharpness(image, ~MASK & MASK)) == (0.0, 0.0)
