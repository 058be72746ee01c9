import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.camera import Camera, crop_from_frame, frame_from_crop
from stream_dmr.messages import Frame
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.segmentation.annotations.annotated_box import AnnotatedBox
from stream_dmr.segmentation.annotations.annotated_fish import AnnotatedFish
from stream_dmr.segmentation.detection.fish_detection import Detection
from stream_dmr.segmentation.masks.crop_geometry import frame_from_crop_map
from stream_dmr.segmentation.masks.crop_settings import CropFishSettings
from stream_dmr.segmentation.masks.cropping import crop_fish
from stream_dmr.segmentation.masks.grabcut_segmenter import GrabCutSegmenter
from stream_dmr.segmentation.masks.mask_cleaning import clean_mask
from stream_dmr.segmentation.segmenter import SegmentedFish

SETTINGS = CropFishSettings()
WIDE = Camera(  # strong barrel distortion, off-centre, unequal focal lengths
    width=1280,
    height=960,
    K=np.array([[980.0, 0.0, 650.0], [0.0, 1000.0, 470.0], [0.0, 0.0, 1.0]]),
    distortion=np.array([-0.28, 0.09, 0.0012, -0.0008, 0.0]),
)


def frame_of(image):
    return Frame(frame_index=1, timestamp_ns=0, image=image, source="test")


def grey_frame(camera, value=128):
    return frame_of(np.full((camera.height, camera.width, 3), value, np.uint8))


def detection_of(mask, *, box=None):
    rows, columns = np.nonzero(mask)
    if box is None:
        box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    return Detection(
        source_id=1, bbox_xyxy_px=np.array(box, np.float64), mask=mask, visible_fraction=1.0
    )


def crop_of(mask, camera, *, box=None, frame=None, **knobs):
    return crop_fish(
        frame or grey_frame(camera),
        detection_of(mask, box=box),
        frame_camera=camera,
        settings=CropFishSettings(**knobs),
        segmenter=GrabCutSegmenter(),
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


cameras = st.builds(
    lambda f, x, y, k1, k2, p: Camera(
        width=640,
        height=480,
        K=np.array([[f, 0.0, 320 + x], [0.0, 1.02 * f, 240 + y], [0.0, 0.0, 1.0]]),
        distortion=np.array([k1, k2, p, -p, 0.0]),
    ),
    st.floats(500, 1500),
    st.floats(-20, 20),
    st.floats(-20, 20),
    st.floats(-0.25, 0.25),
    st.floats(0.0, 0.05),
    st.floats(-0.002, 0.002),
)


@given(cameras, st.floats(0, 639), st.floats(0, 479), st.floats(20, 500), st.integers(1, 3))
@settings(max_examples=30, deadline=None)
def test_the_fast_map_is_the_exact_one(camera, x, y, side, samples):
    crop = camera.crop(center_px=np.array([x, y]), side_px=side, size=32)
    map_x, map_y = frame_from_crop_map(crop, frame_camera=camera, samples=samples)
    places = (np.arange(32 * samples) + 0.5) / samples - 0.5
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    exact = frame_from_crop(grid, crop_camera=crop, frame_camera=camera)
    fast = np.column_stack([map_x.ravel(), map_y.ravel()])
    np.testing.assert_allclose(fast, exact, atol=0.01)


@given(cameras, st.floats(30, 500), st.floats(30, 400), st.floats(10, 300), st.floats(10, 300))
@settings(max_examples=50, deadline=None)
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


def test_a_box_of_no_size_to_speak_of_is_cropped_all_the_same():
    camera = Camera.nominal(width=400, height=300)
    crop = crop_of(np.zeros((300, 400), bool), camera, box=[210, 110, 210 + 1e-9, 110 + 1e-9])
    assert not crop.mask.any()
    assert (crop.image == 128).all()


def test_outside_of_the_frame_there_is_nothing():
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
def test_touching_the_border(rows, columns, touches):
    camera = Camera.nominal(width=60, height=40)
    mask = np.zeros((40, 60), bool)
    mask[slice(*rows), slice(*columns)] = True
    assert crop_of(mask, camera).quality.touches_border is touches


def test_blur_is_less_sharp():
    camera = Camera.nominal(width=200, height=200)
    image = np.random.default_rng(3).integers(0, 256, (200, 200, 3), np.uint8)
    mask = np.zeros((200, 200), bool)
    mask[50:150, 40:160] = True
    sharp = crop_of(mask, camera, frame=frame_of(image))
    blurred = crop_of(mask, camera, frame=frame_of(cv2.GaussianBlur(image, (0, 0), 2)))
    assert 0 < blurred.quality.sharpness < 0.2 * sharp.quality.sharpness


def test_glare_is_the_share_of_the_fish_that_is_blown_out():
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
def test_cleaning_twice_adds_no_sea_and_keeps_the_largest_part(seed, density):
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


def test_a_tiny_mask_counts_as_none():
    camera = Camera.nominal(width=100, height=80)
    mask = np.zeros((80, 100), bool)
    mask[20:27, 20:29] = True  # 63 px
    crop = crop_of(mask, camera)
    assert not crop.mask.any()
    assert (crop.quality.mask_area_px, crop.quality.sharpness) == (0.0, 0.0)
    assert not crop.quality.touches_border


def box_of(track_id, *xyxy, visibility=1.0):
    return AnnotatedBox(
        track_id=track_id, bbox_xyxy_px=np.array(xyxy, np.float64), visibility=visibility
    )


def test_the_node_crops_every_fish_and_stands_in_for_a_missing_camera():
    boxes = {1: [box_of(2, 10, 10, 60, 30), box_of(5, 50, 20, 90, 70, visibility=0.4)]}
    node = CropFish(SETTINGS, camera=None, finder=AnnotatedFish(boxes=boxes, masks=None))
    frame = grey_frame(Camera.nominal(width=120, height=90))
    first, second = node.step(frame)
    assert (first.track_id, second.track_id) == (2, 5)
    assert second.quality.visible_fraction == 0.4
    assert (first.frame_camera.width, first.frame_camera.height) == (120, 90)
    assert first.frame_camera is second.frame_camera
    assert first.image.shape == (128, 128, 3)
    assert node.step(Frame(frame_index=2, timestamp_ns=1, image=frame.image, source="")) == []
    assert (*node.tick(1), *node.close()) == ()


class Painter:
    """A segmenter that takes every white pixel for fish, and half believes the grey ones."""

    def segment(self, image, bbox_xyxy_px):
        self.bbox_xyxy_px = bbox_xyxy_px
        return SegmentedFish(probability=image[..., 0].astype(np.float32) / 255, ends=None)


def segmented(picture, box, camera, **knobs):
    detection = Detection(
        source_id=1, bbox_xyxy_px=np.array(box, np.float64), mask=None, visible_fraction=1.0
    )
    painter = Painter()
    crop = crop_fish(
        frame_of(np.repeat(picture[..., None], 3, axis=2)),
        detection,
        frame_camera=camera,
        settings=CropFishSettings(**knobs),
        segmenter=painter,
    )
    return crop, painter.bbox_xyxy_px


@given(cameras, st.floats(30, 400), st.floats(30, 300), st.floats(40, 200), st.floats(40, 200))
@settings(max_examples=30, deadline=None)
def test_a_mask_found_in_the_crop_is_the_one_given_in_the_frame(camera, x, y, w, h):
    x0, y0, x1, y1 = np.round([x, y, x + w, y + h]).astype(int)
    mask = np.zeros((480, 640), bool)
    mask[y0:y1, x0:x1] = True
    box = [x0, y0, min(x1, 640), min(y1, 480)]
    given_mask = crop_of(mask, camera, box=box)
    found, in_crop = segmented(mask.astype(np.uint8) * 255, box, camera)
    assert (found.mask != given_mask.mask).mean() < 0.002
    # Pixels count whole: the outline is right to half a crop pixel.
    outline_px = 2 * (w + h) * np.sqrt(found.quality.mask_area_px / found.mask.sum())
    assert found.quality.mask_area_px == pytest.approx(mask.sum(), abs=0.6 * outline_px)
    assert found.quality.touches_border == given_mask.quality.touches_border
    rows, columns = np.nonzero(found.mask)
    extent = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    if not camera.distortion.any():
        np.testing.assert_allclose(in_crop, extent, atol=1.5)
    # Through a lens the box's edges are arcs; their middles lie inside the box_from_xywh.
    assert np.all(
        (in_crop[:2] > np.array(extent[:2]) - 1.5) & (in_crop[2:] < np.array(extent[2:]) + 1.5)
    )


@given(st.floats(0.7, 1.0), st.sampled_from([0, 1]), st.booleans())
@settings(max_examples=30, deadline=None)
def test_a_fish_that_goes_on_beyond_its_box_is_found_whole(share, axis, from_its_end):
    strip = np.array([[180, 240], [60, 360]])
    x, y = strip if axis else strip[::-1]
    picture = np.zeros((420, 420), np.uint8)
    picture[slice(*y), slice(*x)] = 255
    box = np.array([x[0], y[0], x[1], y[1]], np.float64)
    box[axis + 2 * (not from_its_end)] = 360 - share * 300 if from_its_end else 60 + share * 300
    camera = Camera.nominal(width=420, height=420)
    crop, _ = segmented(picture, box, camera)
    assert not crop.quality.touches_border
    assert crop.quality.mask_area_px == pytest.approx(60 * 300, rel=0.08)


def test_a_fish_of_which_no_crop_shows_an_end_counts_as_cut():
    picture = np.zeros((420, 420), np.uint8)
    picture[20:400, 200:220] = 255
    crop, _ = segmented(picture, [200, 190, 220, 230], Camera.nominal(width=420, height=420))
    assert crop.quality.touches_border


def test_a_doubtful_mask_is_trusted_less():
    camera = Camera.nominal(width=200, height=200)
    picture = np.zeros((200, 200), np.uint8)
    picture[80:120, 60:140] = 255
    sure, _ = segmented(picture, [60, 80, 140, 120], camera)
    picture[90:110, 60:140] = 160
    doubtful, _ = segmented(picture, [60, 80, 140, 120], camera)
    assert sure.quality.mask_confidence > 0.97
    assert doubtful.quality.mask_confidence == pytest.approx(0.5 + 0.5 * 160 / 255, abs=0.03)
    nothing, _ = segmented(np.zeros_like(picture), [60, 80, 140, 120], camera)
    assert (nothing.quality.mask_confidence, nothing.quality.mask_area_px) == (0.0, 0.0)
    assert crop_of(picture > 0, camera).quality.mask_confidence is None


def test_what_is_found_beyond_the_frame_does_not_count():
    camera = Camera.nominal(width=100, height=80)

    class Everywhere:
        def segment(self, image, bbox_xyxy_px):
            return SegmentedFish(probability=np.ones(image.shape[:2], np.float32), ends=None)

    detection = Detection(
        source_id=1, bbox_xyxy_px=np.array([0.0, 0, 50, 60]), mask=None, visible_fraction=1.0
    )
    frame = grey_frame(camera, 255)
    crop = crop_fish(
        frame, detection, frame_camera=camera, settings=SETTINGS, segmenter=Everywhere()
    )
    np.testing.assert_array_equal(crop.mask, crop.image[..., 0] > 127)
    assert crop.quality.touches_border


@pytest.mark.scenes
def test_masks_of_a_scene_fill_their_crops(scenes):
    from stream_dmr.segmentation.annotations.annotated_fish import open_annotated_fish
    from stream_dmr.sources.open_source import open_source
    from stream_dmr.sources.read_settings import ReadFramesSettings

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
