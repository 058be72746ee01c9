"""Specks and pinholes go; halves, holes and bays stay."""

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.segmentation.crop_geometry import clean_mask


def test_specks_go_and_halves_stay():
    mask = np.zeros((100, 200), bool)
    mask[40:60, 20:180] = True
    mask[:, 90:96] = False  # a gaff
    fish = mask.copy()
    mask[5:8, 5:8] = True  # a speck far off
    mask[50, 40:43] = False  # a pinhole
    np.testing.assert_array_equal(clean_mask(mask, min_area_px=64), fish)


def test_large_holes_and_bays_stay():
    mask = np.zeros((100, 200), bool)
    mask[20:80, 20:180] = True
    mask[40:60, 60:90] = False  # a hole: something in front
    mask[20:22, 100:102] = False  # a bay as small as a pinhole, but open
    np.testing.assert_array_equal(clean_mask(mask, min_area_px=64), mask)


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95))
@settings(deadline=None)
def test_cleaning_adds_no_background_and_keeps_the_largest_part(seed, density):
    noise = np.random.default_rng(seed).random((24, 32)).astype(np.float32)
    mask = cv2.GaussianBlur(noise, (0, 0), 1.5) < np.quantile(noise, density)
    before = mask.copy()
    cleaned = clean_mask(mask, min_area_px=1)
    np.testing.assert_array_equal(mask, before)
    assert cleaned.any() == mask.any()
    filled = np.zeros(mask.shape, np.uint8)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(filled, contours, -1, 1, cv2.FILLED)
    assert not (cleaned & (filled == 0)).any()
