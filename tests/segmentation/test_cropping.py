"""A fish is cut out with the right mask, size and quality facts."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.camera import Camera, crop_from_frame, frame_from_crop
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.segmentation.crop import CropFishSettings
from tests.support.frames import frame_of, grey_frame, lens_cameras
from tests.support.given_masks import crop_of

SETTINGS = CropFishSettings()

WIDE = Camera(  # strong barrel distortion, off-centre, unequal focal lengths
    width=1280,
    height=960,
    K=np.array([[980.0, 0.0, 650.0], [0.0, 1000.0, 470.0], [0.0, 0.0, 1.0]]),
    distortion=np.array([-0.28, 0.09, 0.0012, -0.0008, 0.0]),
)


def outline(*, center, radii, angle, lobes=0.0):
    """A closed curve in ideal rays: an ellipse, wavy if `lobes` is above 0."""
    t = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    x, y = radii[0] * np.cos(t), radii[1] * np.sin(t)
    x, y = (1 + lobes * np.cos(5 * t)) * x, (1 + lobes * np.cos(5 * t)) * y
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([center[0] + c * x - s * y, center[1] + s * x + c * y, np.ones_like(t)])


def rasterize(polygon_px, *, width, height):
    """True where a pixel's centre is inside; drawn 8 times finer, so good to 1/8 px."""
    fine = np.zeros((height * 8, width * 8), np.uint8)
    cv2.fillPoly(fine, [np.round((polygon_px + 0.5) * 8 - 0.5).astype(np.int32)], 1)
    return fine[4::8, 4::8] == 1


def boundary_distances(mask, curve_px):
    """From the centres of the edges between mask and background to a curve, px."""
    horizontal = np.argwhere(mask[:, 1:] != mask[:, :-1])[:, ::-1] + [0.5, 0.0]
    vertical = np.argwhere(mask[1:] != mask[:-1])[:, ::-1] + [0.0, 0.5]
    edges = np.concatenate([horizontal, vertical])
    return np.linalg.norm(edges[:, None] - curve_px[None], axis=2).min(axis=1)


def area_of(curve_px):
    x, y = curve_px.T
    return 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))


@pytest.mark.parametrize(
    ("center", "radii", "angle", "lobes"),
    [
        ((0.0, 0.0), (0.2, 0.2), 0.0, 0.0),
        ((0.3, -0.2), (0.25, 0.07), 0.6, 0.0),
        ((-0.4, 0.3), (0.12, 0.05), -1.2, 0.0),
        ((-0.2, -0.1), (0.25, 0.12), 2.0, 0.15),
    ],
)
@pytest.mark.parametrize("size", [96, 192])
def test_a_known_shape_lands_where_it_belongs(center, radii, angle, lobes, size):
    rays = outline(center=center, radii=radii, angle=angle, lobes=lobes)
    mask = rasterize(WIDE.project(rays), width=WIDE.width, height=WIDE.height)
    crop = crop_of(mask, WIDE, crop_size_px=size)
    truth = crop.crop_camera.project(rays)
    assert crop.mask.sum() == pytest.approx(area_of(truth), rel=0.005)
    # An edge between two pixels of even a perfect mask lies up to some 0.5 px off the curve.
    perfect = boundary_distances(rasterize(truth, width=size, height=size), truth)
    distances = boundary_distances(crop.mask, truth)
    assert distances.mean() < perfect.mean() + 0.05
    assert distances.mean() < 0.3
    scale = crop.crop_camera.K[0, 0] / WIDE.K[0, 0]
    assert distances.max() < 0.75 + 0.5 * scale  # half a crop pixel and half a frame pixel


@given(lens_cameras, st.floats(30, 500), st.floats(30, 400), st.floats(10, 300), st.floats(10, 300))
def test_the_whole_box_is_in_the_crop_with_its_margin(camera, x, y, w, h):
    box = [x, y, min(x + w, 640), min(y + h, 480)]
    crop = crop_of(np.zeros((480, 640), bool), camera, box=box)
    x0, y0, x1, y1 = np.array(box) - 0.5
    box_from_xywh = np.array([[x0, y0], [x1, y0], [x0, y1], [x1, y1]])
    seen = crop_from_frame(box_from_xywh, crop_camera=crop.crop_camera, frame_camera=camera)
    margin = 128 * 0.15 / 1.3
    assert seen.min() > margin - 1.0
    assert seen.max() < 127 - margin + 1.0
    extent = seen.max(axis=0) - seen.min(axis=0)
    assert extent.max() > 128 - 2 * margin - 24  # the longer side fills the rest (bulges aside)


def test_without_distortion_a_crop_is_a_cut_of_the_frame():
    camera = Camera.nominal(width=300, height=200)
    image = np.random.default_rng(0).integers(0, 256, (200, 300, 3), np.uint8)
    mask = np.zeros((200, 300), bool)
    mask[50:100, 120:184] = True  # 64 px wide; a crop of 64 px at this size needs no margin
    crop = crop_of(mask, camera, frame=frame_of(image), crop_size_px=64, margin=0.0)
    np.testing.assert_array_equal(crop.image, image[43:107, 120:184])
    np.testing.assert_array_equal(crop.mask, mask[43:107, 120:184])
    assert crop.quality.mask_area_px == 50 * 64


def test_a_shrunken_image_is_averaged():
    camera = Camera.nominal(width=600, height=600)
    stripes = np.zeros((600, 600, 3), np.uint8)
    stripes[:, ::2] = 200
    mask = np.zeros((600, 600), bool)
    mask[100:484, 100:484] = True
    crop = crop_of(mask, camera, frame=frame_of(stripes), crop_size_px=96, margin=0.0)
    assert np.abs(crop.image.astype(int) - 100).max() <= 1  # single samples would give 0 and 200


def test_the_crop_covers_box_and_mask_and_keeps_the_box():
    camera = Camera.nominal(width=400, height=300)
    mask = np.zeros((300, 400), bool)
    mask[100:120, 200:260] = True
    crop = crop_of(mask, camera, box=[180, 90, 240, 130])
    assert list(crop.bbox_xyxy_px) == [180, 90, 240, 130]
    assert crop.crop_camera.K[0, 0] / camera.K[0, 0] == pytest.approx(128 / (80 * 1.3))
    middle = frame_from_crop(
        np.array([[63.5, 63.5]]), crop_camera=crop.crop_camera, frame_camera=camera
    )
    np.testing.assert_allclose(middle, [[219.5, 109.5]], atol=1e-6)


def test_a_mask_larger_than_its_box_widens_the_crop():
    camera = Camera.nominal(width=400, height=300)
    mask = np.zeros((300, 400), bool)
    mask[100:130, 200:260] = True
    crop = crop_of(mask, camera, box=[210.5, 110.5, 220.5, 120.5])
    assert crop.crop_camera.K[0, 0] / camera.K[0, 0] == pytest.approx(128 / (60 * 1.3))


def test_a_box_of_nearly_no_size_is_cropped():
    camera = Camera.nominal(width=400, height=300)
    crop = crop_of(np.zeros((300, 400), bool), camera, box=[210, 110, 210 + 1e-9, 110 + 1e-9])
    assert not crop.mask.any()
    assert (crop.image == 128).all()


def test_outside_the_frame_image_and_mask_are_empty():
    camera = Camera.nominal(width=100, height=80)
    mask = np.zeros((80, 100), bool)
    mask[:, :60] = True
    crop = crop_of(mask, camera, box=[-40, -40, 60, 120], frame=grey_frame(camera, 255))
    assert not crop.image[:, :5].any()
    assert not crop.mask[:, :5].any()
    assert crop.image[96, 96].min() == 255


@pytest.mark.parametrize(
    ("rows", "columns", "touches"),
    [
        ((10, 20), (10, 20), False),
        ((2, 20), (2, 20), False),
        ((1, 20), (10, 20), True),
        ((10, 20), (0, 20), True),
        ((10, 39), (10, 20), True),
        ((10, 38), (10, 58), False),
        ((10, 20), (10, 60), True),
    ],
)
def test_a_mask_at_the_edge_touches_the_border(rows, columns, touches):
    camera = Camera.nominal(width=60, height=40)
    mask = np.zeros((40, 60), bool)
    mask[slice(*rows), slice(*columns)] = True
    assert crop_of(mask, camera).quality.touches_border is touches


def test_a_blurred_image_is_less_sharp():
    camera = Camera.nominal(width=200, height=200)
    image = np.random.default_rng(3).integers(0, 256, (200, 200, 3), np.uint8)
    mask = np.zeros((200, 200), bool)
    mask[50:150, 40:160] = True
    sharp = crop_of(mask, camera, frame=frame_of(image))
    blurred = crop_of(mask, camera, frame=frame_of(cv2.GaussianBlur(image, (0, 0), 2)))
    assert 0 < blurred.quality.sharpness < 0.2 * sharp.quality.sharpness


def test_glare_is_the_overexposed_fraction_of_the_fish():
    camera = Camera.nominal(width=200, height=200)
    mask = np.zeros((200, 200), bool)
    mask[50:150, 40:160] = True
    image = np.full((200, 200, 3), 180, np.uint8)
    image[50:150, 40:70] = 255  # a quarter of the fish
    image[:50] = 255  # foam beside it
    image[50:150, 100:130, 0] = 255  # blue, not white
    assert crop_of(mask, camera, frame=frame_of(image)).quality.glare == pytest.approx(
        0.25, abs=0.02
    )


def test_a_tiny_mask_counts_as_none():
    camera = Camera.nominal(width=100, height=80)
    mask = np.zeros((80, 100), bool)
    mask[20:27, 20:29] = True  # 63 px
    crop = crop_of(mask, camera)
    assert not crop.mask.any()
    assert (crop.quality.mask_area_px, crop.quality.sharpness) == (0.0, 0.0)
    assert not crop.quality.touches_border


@pytest.mark.scenes
def test_masks_of_a_scene_fill_their_crops(scenes):
    from stream_dmr.detection.given_fish import open_annotated_fish
    from stream_dmr.sources.open_source import open_source
    from stream_dmr.sources.source import ReadFramesSettings

    scene = scenes / "realistic"
    detections = open_annotated_fish(boxes=scene / "boxes.txt", masks=scene / "masks")
    node = CropFish(SETTINGS, camera=None, finder=detections)
    crops = []
    source = open_source(str(scene / "video.mp4"), ReadFramesSettings())
    for frame in source:
        crops += node.step(frame)
        if frame.frame_index == 30:
            break
    source.close()
    assert len(crops) > 30
    assert all(crop.mask.any() and not crop.mask[[0, -1]].any() for crop in crops)
