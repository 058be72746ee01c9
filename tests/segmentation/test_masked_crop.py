"""Masks found by a segmenter: in the whole fish, in frame pixels, with a confidence."""

from dataclasses import asdict

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.camera import Camera
from stream_dmr.segmentation.crop import CropFishSettings, Detection, crop_fish
from stream_dmr.segmentation.segmenter import SegmentedFish
from tests.support.frames import frame_of, grey_frame, lens_cameras
from tests.support.given_masks import crop_of

SETTINGS = CropFishSettings()


class Painter:
    """A segmenter that takes every white pixel for fish, and half believes the grey ones."""

    knows_fish = True

    def segment(self, image, bbox_xyxy_px):
        self.bbox_xyxy_px = bbox_xyxy_px
        return SegmentedFish(probability=image[..., 0].astype(np.float32) / 255, ends=None)


class OneSided(Painter):
    """A segmenter that overlooks what is on the left of a picture."""

    def segment(self, image, bbox_xyxy_px):
        found = super().segment(image, bbox_xyxy_px)
        found.probability[:, : len(image) // 3] = 0
        return found


def segmented(picture, box, camera, *, may_be_no_fish=False, painter=None, **knobs):
    detection = Detection(
        source_id=1,
        bbox_xyxy_px=np.array(box, np.float64),
        mask=None,
        visible_fraction=1.0,
        may_be_no_fish=may_be_no_fish,
    )
    painter = painter or Painter()
    crop = crop_fish(
        frame_of(np.repeat(picture[..., None], 3, axis=2)),
        detection,
        frame_camera=camera,
        settings=CropFishSettings(**knobs),
        segmenter=painter,
    )
    return crop, painter.bbox_xyxy_px


def test_a_mask_of_a_part_of_the_frame_gives_the_same_crop():
    whole = np.zeros((480, 640), bool)
    whole[200:260, 300:420] = True
    whole[230:250, 330:340] = False
    camera, box = Camera.nominal(width=640, height=480), np.array([300.0, 200.0, 420.0, 260.0])
    crops = [
        crop_fish(
            grey_frame(camera),
            Detection(
                source_id=1, bbox_xyxy_px=box, mask=mask, mask_corner=corner, visible_fraction=1.0
            ),
            frame_camera=camera,
            settings=SETTINGS,
            segmenter=None,
        )
        for mask, corner in ((whole, (0, 0)), (whole[190:270, 290:430], (290, 190)))
    ]
    np.testing.assert_array_equal(crops[0].mask, crops[1].mask)
    np.testing.assert_array_equal(crops[0].crop_camera.K, crops[1].crop_camera.K)
    assert asdict(crops[0].quality) == asdict(crops[1].quality)


@given(lens_cameras, st.floats(30, 400), st.floats(30, 300), st.floats(40, 200), st.floats(40, 200))
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
    gap_px = min(box[0], box[1], 640 - box[2], 480 - box[3])
    pixel_px = camera.K[0, 0] / found.crop_camera.K[0, 0]
    if gap_px <= 1 or gap_px > 2 * pixel_px + 1:  # in between it is seen too coarsely to say
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
def test_a_fish_that_extends_beyond_its_box_is_found_whole(share, axis, from_its_end):
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


@pytest.mark.parametrize(("side_px", "seen_px"), [(60, 128), (160, 192), (400, 256)])
def test_a_segmenter_sees_no_more_pixels_than_the_frame_has(side_px, seen_px):
    camera = Camera.nominal(width=640, height=640)
    picture = np.zeros((640, 640), np.uint8)
    picture[100 : 100 + side_px // 4, 80 : 80 + side_px] = 255
    box = [80, 100, 80 + side_px, 100 + side_px // 4]
    crop, seen = segmented(picture, box, camera, segmenter_sizes_px=[256, 128, 192])
    coarse, _ = segmented(picture, box, camera)
    assert seen[2] - seen[0] == pytest.approx(seen_px / 1.3, rel=0.02)
    assert crop.image.shape == coarse.image.shape == (128, 128, 3)
    assert crop.quality.mask_area_px == pytest.approx(side_px * (side_px // 4), rel=0.06)
    both, either = crop.mask & coarse.mask, crop.mask | coarse.mask
    assert both.sum() > 0.95 * either.sum()


def test_of_several_sizes_left_and_right_are_seen_alike():
    camera = Camera.nominal(width=640, height=480)
    picture = np.zeros((480, 640), np.uint8)
    cv2.ellipse(picture, (300, 240), (120, 40), 10, 0, 360, 255, -1)
    crops = [
        segmented(
            image, box, camera, painter=OneSided(), segmenter_sizes_px=[128, 192], second_look=True
        )[0]
        for image, box in (
            (picture, [178, 190, 422, 290]),
            (picture[:, ::-1], [218, 190, 462, 290]),
        )
    ]
    np.testing.assert_array_equal(crops[0].mask, crops[1].mask[:, ::-1])
    assert crops[0].quality.mask_confidence == pytest.approx(crops[1].quality.mask_confidence)


def test_a_fish_that_no_crop_shows_whole_touches_the_border():
    picture = np.zeros((420, 420), np.uint8)
    picture[20:400, 200:220] = 255
    crop, _ = segmented(picture, [200, 190, 220, 230], Camera.nominal(width=420, height=420))
    assert crop.quality.touches_border


@pytest.mark.parametrize(("end", "is_cut"), [(4000, True), (3850, False)])
def test_a_fish_at_the_edge_of_a_large_picture_touches_the_border(end, is_cut):
    """A pixel of its crop has 30 of the picture's."""
    picture = np.zeros((1000, 4000), np.uint8)
    picture[400:700, 1013:end] = 255
    crop, _ = segmented(picture, [1013, 400, end, 700], Camera.nominal(width=4000, height=1000))
    assert crop.quality.touches_border == is_cut


def test_an_uncertain_mask_has_a_lower_confidence():
    camera = Camera.nominal(width=200, height=200)
    picture = np.zeros((200, 200), np.uint8)
    picture[80:120, 60:140] = 255
    sure, _ = segmented(picture, [60, 80, 140, 120], camera)
    picture[90:110, 60:140] = 160
    doubtful, _ = segmented(picture, [60, 80, 140, 120], camera)
    assert sure.quality.mask_confidence > 0.93
    expected_iou = 0.5 + 0.5 * 160 / 255
    assert doubtful.quality.mask_confidence == pytest.approx(expected_iou**2.85, abs=0.05)
    nothing, _ = segmented(np.zeros_like(picture), [60, 80, 140, 120], camera)
    assert (nothing.quality.mask_confidence, nothing.quality.mask_area_px) == (0.0, 0.0)
    assert crop_of(picture > 0, camera).quality.mask_confidence is None


def test_a_mask_found_beyond_the_frame_does_not_count():
    camera = Camera.nominal(width=100, height=80)

    class Everywhere:
        knows_fish = False

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


@given(st.integers(200, 400), st.integers(150, 300), st.integers(50, 90), st.integers(50, 90))
@settings(max_examples=10, deadline=None)
def test_what_looks_alike_in_a_wider_view_keeps_its_confidence(x, y, w, h):
    camera = Camera.nominal(width=640, height=480)
    picture = np.zeros((480, 640), np.uint8)
    picture[y : y + h, x : x + w] = 255
    box = [x, y, x + w, y + h]
    known, _ = segmented(picture, box, camera)
    found, _ = segmented(picture, box, camera, may_be_no_fish=True)
    assert found.quality.mask_confidence == known.quality.mask_confidence > 0.9
    np.testing.assert_array_equal(found.mask, known.mask)


class Shortsighted(Painter):
    """Takes for fish what is white, unless it sees at least so many px of the frame at once."""

    least = 0.3  # share of the picture that is white

    def segment(self, image, bbox_xyxy_px):
        found = super().segment(image, bbox_xyxy_px)
        white = np.count_nonzero(image[..., 0] > 127) / image[..., 0].size
        return (
            found
            if white > self.least
            else SegmentedFish(probability=0 * found.probability, ends=None)
        )


@pytest.mark.parametrize("knows_fish", [True, False])
def test_what_vanishes_in_a_wider_view_is_doubted_by_a_segmenter_that_knows_fish(knows_fish):
    camera = Camera.nominal(width=640, height=480)
    picture = np.zeros((480, 640), np.uint8)
    picture[200:260, 300:360] = 255
    segmenter = Shortsighted()
    segmenter.knows_fish = knows_fish
    crop = crop_fish(
        frame_of(np.repeat(picture[..., None], 3, axis=2)),
        Detection(
            source_id=1,
            bbox_xyxy_px=np.array([300.0, 200.0, 360.0, 260.0]),
            mask=None,
            visible_fraction=1.0,
            may_be_no_fish=True,
        ),
        frame_camera=camera,
        settings=SETTINGS,
        segmenter=segmenter,
    )
    assert crop.mask.any()
    assert (crop.quality.mask_confidence < 0.1) == knows_fish


@pytest.mark.parametrize("angle_deg", [0, 30, 45, 135])
def test_a_thin_fish_of_a_still_is_not_too_small_in_the_wider_view_however_it_lies(angle_deg):
    picture = np.zeros((480, 640), np.uint8)
    cv2.ellipse(picture, ((320, 240), (260, 60), angle_deg), 255, -1)
    segmenter = Shortsighted()
    segmenter.knows_fish, segmenter.least = True, 0.065
    x, y, w, h = cv2.boundingRect(picture)
    crop = crop_fish(
        frame_of(np.repeat(picture[..., None], 3, axis=2)),
        Detection(
            source_id=1,
            bbox_xyxy_px=np.array([x, y, x + w, y + h], np.float64),
            mask=None,
            visible_fraction=1.0,
            may_be_no_fish=True,
        ),
        frame_camera=Camera.nominal(width=640, height=480),
        settings=CropFishSettings(second_look=True),
        segmenter=segmenter,
    )
    assert crop.quality.mask_confidence > 0.9


class Obedient(Painter):
    """Finds fish inside of the box alone, and is less sure where one goes on beyond it."""

    def segment(self, image, bbox_xyxy_px):
        x0, y0, x1, y1 = np.round(bbox_xyxy_px).astype(int)
        white = image[..., 0] > 127
        inside = np.zeros_like(white)
        inside[max(y0, 0) : y1, max(x0, 0) : x1] = True
        sure = 1.0 if white[inside].sum() > 0.95 * white.sum() else 0.9
        return SegmentedFish(probability=sure * (white & inside).astype(np.float32), ends=None)


@pytest.mark.parametrize("second_look", [False, True])
def test_a_second_look_finds_the_tail_that_a_box_lacks(second_look):
    camera = Camera.nominal(width=640, height=480)
    picture = np.zeros((480, 640), np.uint8)
    picture[180:330, 200:470] = 255
    frame = frame_of(np.repeat(picture[..., None], 3, axis=2))
    detection = Detection(
        source_id=1,
        bbox_xyxy_px=np.array([200.0, 180.0, 430.0, 330.0]),
        mask=None,
        visible_fraction=1.0,
        may_be_no_fish=True,
    )
    knobs = CropFishSettings(second_look=second_look)
    crop = crop_fish(frame, detection, frame_camera=camera, settings=knobs, segmenter=Obedient())
    length_px = 270 if second_look else 230
    assert crop.quality.mask_area_px == pytest.approx(length_px * 150, rel=0.05)
    # Whether it is a fish says the first look.
    assert crop.quality.mask_confidence == pytest.approx(0.9**2.85, abs=0.02)
    assert (crop.quality.length_doubt is None) == (not second_look)
    assert (crop.quality.missing_end is None) == (not second_look)


class Believer(Painter):
    """Finds what is inside of the box, as sure as ever."""

    def segment(self, image, bbox_xyxy_px):
        x0, y0, x1, y1 = np.round(bbox_xyxy_px).astype(int)
        inside = np.zeros(image.shape[:2], bool)
        inside[max(y0, 0) : y1, max(x0, 0) : x1] = True
        found = ((image[..., 0] > 127) & inside).astype(np.float32)
        return SegmentedFish(probability=np.float32(0.9) * found, ends=None)


@pytest.mark.parametrize("lost_px", [0, 30])
def test_an_end_that_only_a_longer_box_shows_is_taken_and_doubted(lost_px):
    camera = Camera.nominal(width=640, height=480)
    picture = np.zeros((480, 640), np.uint8)
    picture[200:320, 200:500] = 255
    box = np.array([200.0, 200.0, 500.0 - lost_px, 320.0])
    detection = Detection(source_id=1, bbox_xyxy_px=box, mask=None, visible_fraction=1.0)
    frame = frame_of(np.repeat(picture[..., None], 3, axis=2))
    knobs = CropFishSettings(second_look=True)
    crop = crop_fish(frame, detection, frame_camera=camera, settings=knobs, segmenter=Believer())
    assert crop.quality.mask_area_px == pytest.approx(300 * 120, rel=0.07)
    assert crop.quality.length_doubt == pytest.approx(lost_px / (300 - lost_px), abs=0.03)


class Fickle(Painter):
    """Finds the fish in a box around it, and nothing in a longer one."""

    def segment(self, image, bbox_xyxy_px):
        white = image[..., 0] > 127
        is_longer = np.ptp(bbox_xyxy_px[::2]) > 1.15 * np.ptp(np.nonzero(white)[1])
        return SegmentedFish(probability=(white & ~is_longer).astype(np.float32), ends=None)


def test_a_fish_that_a_longer_box_does_not_show_keeps_its_mask_and_is_doubted():
    picture = np.zeros((480, 640), np.uint8)
    picture[200:320, 200:500] = 255
    detection = Detection(
        source_id=1,
        bbox_xyxy_px=np.array([200.0, 200.0, 500.0, 320.0]),
        mask=None,
        visible_fraction=1.0,
    )
    crop = crop_fish(
        frame_of(np.repeat(picture[..., None], 3, axis=2)),
        detection,
        frame_camera=Camera.nominal(width=640, height=480),
        settings=CropFishSettings(second_look=True),
        segmenter=Fickle(),
    )
    assert crop.quality.mask_area_px == pytest.approx(300 * 120, rel=0.07)
    assert crop.quality.length_doubt == pytest.approx(0.15)


def test_a_part_of_something_larger_is_doubted():
    camera = Camera.nominal(width=640, height=480)
    picture = np.zeros((480, 640), np.uint8)
    picture[180:340, 200:500] = 255
    whole, _ = segmented(picture, [200, 180, 500, 340], camera, may_be_no_fish=True)
    part, _ = segmented(picture, [300, 220, 340, 250], camera, may_be_no_fish=True)
    assert whole.quality.mask_confidence > 0.9
    assert part.quality.mask_confidence < 0.4


def strip(*, tapers: bool) -> np.ndarray:
    """A slanted strip on black, or an ellipse as long and as broad."""
    picture = np.zeros((480, 640), np.uint8)
    if tapers:
        cv2.ellipse(picture, (320, 240), (120, 20), 30, 0, 360, 255, cv2.FILLED)
    else:
        corners = cv2.boxPoints(((320.0, 240.0), (240.0, 40.0), 30.0))
        cv2.fillConvexPoly(picture, np.round(corners).astype(np.int32), 255)
    return picture


@pytest.mark.parametrize(
    ("tapers", "may_be_no_fish", "is_sure"),
    [(False, True, False), (True, True, True), (False, False, True)],
)
def test_an_oblong_rectangle_is_a_label_unless_it_is_known_as_a_fish(
    tapers, may_be_no_fish, is_sure
):
    camera = Camera.nominal(width=640, height=480)
    box = [205, 160, 435, 320]
    crop, _ = segmented(strip(tapers=tapers), box, camera, may_be_no_fish=may_be_no_fish)
    assert (crop.quality.mask_confidence > 0.9) == is_sure


def test_the_trunk_of_a_fish_that_the_picture_cuts_off_may_be_a_rectangle():
    picture = np.zeros((480, 640), np.uint8)
    picture[220:260, :200] = 255
    camera = Camera.nominal(width=640, height=480)
    crop, _ = segmented(picture, [0, 220, 200, 260], camera, may_be_no_fish=True)
    assert crop.quality.mask_confidence > 0.9
