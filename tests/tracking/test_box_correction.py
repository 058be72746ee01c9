"""Boxes follow the confident masks of the previous frame, within limits."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.camera import Camera
from stream_dmr.tracking.box_correction import BoxCorrector
from tests.support.frames import grey_frame
from tests.support.given_masks import crop_of

CAMERA = Camera.nominal(width=400, height=300)
FRAME = grey_frame(CAMERA)
BOX = np.array([100.0, 100.0, 300.0, 200.0])  # the longer side is 200 px


def corrected(box: np.ndarray, *, mask_box: list[int], confidence: float) -> np.ndarray:
    """The box of frame 2, after a mask in the box of frame 1."""
    mask = np.zeros((300, 400), bool)
    x0, y0, x1, y1 = mask_box
    mask[y0:y1, x0:x1] = True
    crop = crop_of(mask, CAMERA, crop_size_px=512)
    crop = replace(crop, quality=replace(crop.quality, mask_confidence=confidence))
    corrector = BoxCorrector()
    corrector.correct({3: box}, {3: 1.0}, FRAME)
    corrector.update({3: crop})
    [detection] = corrector.correct({3: box}, {3: 0.5}, FRAME)
    assert (detection.source_id, detection.visible_fraction, detection.mask) == (3, 0.5, None)
    return detection.bbox_xyxy_px


@given(st.lists(st.integers(-15, 15), min_size=4, max_size=4))
def test_a_box_moves_to_the_mask_where_they_differ_clearly(offsets: list[int]):
    mask_box = (BOX + offsets).astype(int).tolist()
    moved = corrected(BOX, mask_box=mask_box, confidence=0.95) - BOX
    for offset, by in zip(offsets, moved, strict=True):
        if abs(offset) > 7:  # 3 % of 200 px, and a pixel of the crop
            assert by == pytest.approx(offset, abs=1)
        if abs(offset) < 5:
            assert by == 0


def test_a_box_moves_by_a_tenth_of_its_length_at_most():
    box = corrected(BOX, mask_box=[150, 100, 399, 200], confidence=0.95)
    np.testing.assert_allclose(box, [120, 100, 320, 200], atol=1)


def test_a_corrected_box_stays_in_the_frame():
    at_edge = np.array([0.0, 0.0, 390.0, 200.0])
    box = corrected(at_edge, mask_box=[0, 0, 400, 230], confidence=0.95)
    assert (box[:2] >= 0).all()
    assert (box[2:] <= [400, 300]).all()


def test_masks_of_low_confidence_correct_no_box():
    moved = corrected(BOX, mask_box=[80, 100, 320, 200], confidence=0.73)
    np.testing.assert_array_equal(moved, BOX)
