"""The pictures of a report: what is drawn over a crop, and where."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stream_dmr.messages import FishCrop, FittedMesh, Frame
from stream_dmr.web.views import crop_outlines, crop_picture, draw_outlines
from tests.support.recorded_run import CROP, run, template

MESSAGES = list(run(1, num_fish=1))
FRAME = next(m for m in MESSAGES if isinstance(m, Frame))
CROPPED = next(m for m in MESSAGES if isinstance(m, FishCrop))
SHAPE = next(m for m in MESSAGES if isinstance(m, FittedMesh)).shape
assert SHAPE is not None


def filled(lines) -> np.ndarray:
    image = np.zeros((CROP, CROP), np.uint8)
    for line in lines:
        cv2.fillPoly(image, [np.round(line).astype(np.int32)], 1)
    return image > 0


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return (one & other).sum() / (one | other).sum()


def test_outlines_enclose_the_mask_and_the_mesh_over_it():
    outlines = crop_outlines(CROPPED, SHAPE, template().faces)
    assert iou(filled(outlines.mask), CROPPED.mask) > 0.95
    assert iou(filled(outlines.mesh), CROPPED.mask) > 0.9
    x, y = np.round(outlines.keypoints[1]).astype(int)
    assert CROPPED.mask[y, x]


def test_a_fit_without_vertices_has_no_outline_of_a_mesh():
    outlines = crop_outlines(CROPPED, replace(SHAPE, vertices=None), template().faces)
    assert outlines.mesh == []
    assert len(outlines.mask) > 0


@pytest.mark.parametrize("size", [64, 128, 240])
def test_a_crop_from_its_frame_is_the_recorded_crop(size: int):
    assert CROPPED.image is not None
    recorded = cv2.resize(CROPPED.image, (size, size), interpolation=cv2.INTER_AREA)
    found = crop_picture(CROPPED, FRAME.image, size=size)
    assert found.shape == (size, size, 3)
    smooth = (cv2.GaussianBlur(picture, (0, 0), size / 40) for picture in (found, recorded))
    assert np.abs(np.subtract(*(p.astype(float) for p in smooth))).mean() < 4


def test_without_any_picture_the_mask_is_shown():
    bare = replace(CROPPED, image=None)
    found = crop_picture(bare, None, size=CROP)
    assert iou(found[..., 0] > 80, CROPPED.mask) > 0.98


def test_drawing_changes_a_copy_near_the_outlines_alone():
    picture = np.zeros((240, 240, 3), np.uint8)
    outlines = crop_outlines(CROPPED, SHAPE, template().faces)
    drawn = draw_outlines(picture, outlines, crop_size=CROP)
    assert not picture.any()
    assert 0 < (drawn.any(axis=2)).mean() < 0.2
