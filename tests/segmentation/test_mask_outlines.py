"""A mask as polygons or run lengths is the same mask again."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stream_dmr.errors import AnnotationError
from stream_dmr.segmentation.mask_outlines import decode_coco, fill_parts, outlines_of, run_lengths
from tests.support.frames import ellipse_mask

sizes = st.integers(1, 40)
masks = arrays(np.bool_, st.tuples(sizes, sizes))


@given(masks)
def test_run_lengths_give_the_mask(mask: np.ndarray):
    coco = {"size": list(mask.shape), "counts": run_lengths(mask)}
    np.testing.assert_array_equal(decode_coco(mask.shape, coco, where=""), mask)


@given(masks)
def test_polygons_with_holes_give_the_mask(mask: np.ndarray):
    """Parts that touch at corners, holes, islands in them, and what the picture's edge cuts off."""
    np.testing.assert_array_equal(fill_parts(mask.shape, outlines_of(mask)), mask)


@pytest.mark.parametrize("seed", range(3))
def test_smooth_outlines_need_few_corners(seed: int):
    rng = np.random.default_rng(seed)
    mask = cv2.GaussianBlur(rng.random((200, 300)), (0, 0), 12) > 0.5
    parts = outlines_of(mask)
    np.testing.assert_array_equal(fill_parts(mask.shape, parts), mask)
    edges = np.count_nonzero(mask[1:] ^ mask[:-1]) + np.count_nonzero(mask[:, 1:] ^ mask[:, :-1])
    assert sum(len(ring) for part in parts for ring in part) < edges / 2


def test_lines_through_border_pixels_and_along_their_edges_are_both_right():
    mask = ellipse_mask(angle=30.0) > 0
    [line], _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    np.testing.assert_array_equal(fill_parts(mask.shape, [[line[:, 0] + 0.5]]), mask)


def test_what_lies_outside_the_picture_is_cut_off():
    ring = np.array([[-50.0, -50.0], [5.0, -50.0], [5.0, 500.0], [-50.0, 500.0]])
    mask = fill_parts((10, 20), [[ring], [ring + 1000]])
    assert mask[:, :5].all()
    assert not mask[:, 5:].any()


@pytest.mark.parametrize("far", [1e308, -1e308, 2e6])
def test_corners_far_from_any_picture_are_refused(far: float):
    with pytest.raises(AnnotationError, match=r"annotation 3: expected corners .* within 1e.06 px"):
        decode_coco((10, 20), [[1.0, 1.0, far, 1.0, 6.0, 6.0]], where="annotation 3")


def test_masks_that_overlap_add_up():
    square = np.array([[1.0, 1.0], [6.0, 1.0], [6.0, 6.0], [1.0, 6.0]])
    rings = [square.ravel().tolist(), (square + 2).ravel().tolist()]
    assert decode_coco((10, 20), rings, where="").sum() == 25 + 25 - 9
