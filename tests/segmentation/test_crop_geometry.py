"""Boxes and pixels between frame and crop."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.camera import Camera, frame_from_crop
from stream_dmr.segmentation.crop_geometry import (
    Layer,
    box_in_crop,
    frame_from_crop_map,
    mask_bbox,
    mask_bbox_in_frame,
    resample,
    visible_bbox,
)
from tests.support.frames import lens_cameras
from tests.support.given_masks import crop_of


@given(lens_cameras, st.floats(0, 639), st.floats(0, 479), st.floats(20, 500), st.integers(1, 3))
def test_the_fast_map_is_the_exact_one(camera, x, y, side, samples):
    crop = camera.crop(center_px=np.array([x, y]), side_px=side, size=32)
    map_x, map_y = frame_from_crop_map(crop, frame_camera=camera, samples=samples)
    places = (np.arange(32 * samples) + 0.5) / samples - 0.5
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    exact = frame_from_crop(grid, crop_camera=crop, frame_camera=camera)
    fast = np.column_stack([map_x.ravel(), map_y.ravel()])
    np.testing.assert_allclose(fast, exact, atol=0.01)


@given(
    lens_cameras,
    st.floats(100, 440),
    st.floats(100, 300),
    st.floats(20, 120),
    st.floats(20, 120),
)
def test_a_box_goes_to_the_crop_and_a_mask_in_it_comes_back(
    camera: Camera, x: float, y: float, w: float, h: float
):
    box = np.round([x, y, x + w, y + h])
    mask = np.zeros((480, 640), bool)
    x0, y0, x1, y1 = box.astype(int)
    mask[y0:y1, x0:x1] = True
    crop = crop_of(mask, camera, crop_size_px=256)
    inside = box_in_crop(box, crop_camera=crop.crop_camera, frame_camera=camera)
    assert ((inside > 0) & (inside < 256)).all()
    back = mask_bbox_in_frame(crop)
    assert back is not None
    pixel = crop.frame_camera.K[0, 0] / crop.crop_camera.K[0, 0]  # of the crop, in the frame
    np.testing.assert_allclose(back, box, atol=1 + 2 * pixel)


def test_an_empty_mask_has_no_box():
    assert mask_bbox(np.zeros((4, 5), bool)) is None


@given(st.integers(0, 30), st.integers(0, 30), st.integers(1, 9), st.integers(1, 9))
def test_the_box_of_a_mask_is_tight_and_half_open(x: int, y: int, w: int, h: int):
    mask = np.zeros((40, 40), bool)
    mask[y : y + h, x : x + w] = True
    box = mask_bbox(mask)
    assert box is not None
    assert box.tolist() == [x, y, min(x + w, 40), min(y + h, 40)]


def test_a_visible_box_is_clipped_and_encloses_the_mask():
    mask = np.zeros((30, 40), bool)
    mask[2:5, 20:38] = True
    box = np.array([-10.0, 10, 15, 50])
    assert visible_bbox(box, None, width=40, height=30).tolist() == [0, 10, 15, 30]
    assert visible_bbox(box, mask_bbox(mask), width=40, height=30).tolist() == [0, 2, 38, 30]


@given(lens_cameras, st.floats(100, 500), st.floats(100, 400), st.floats(20, 500), st.data())
def test_a_part_of_a_picture_is_seen_as_the_whole_one(camera, x, y, side, data):
    """As long as the rest of the picture is 0."""
    left, top = data.draw(st.integers(0, 600)), data.draw(st.integers(0, 440))
    part = np.random.default_rng(left).integers(0, 256, (40, 40), np.uint8)
    whole = np.zeros((480, 640), np.uint8)
    whole[top : top + 40, left : left + 40] = part
    crop = camera.crop(center_px=np.array([x, y]), side_px=side, size=32)
    one, other = resample(
        [Layer(whole), Layer(part, (left, top))], crop_camera=crop, frame_camera=camera
    )
    np.testing.assert_array_equal(one, other)
