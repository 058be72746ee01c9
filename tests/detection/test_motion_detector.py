"""Moving fish are found before a background that follows the camera."""

import cv2
import numpy as np
import pytest

from stream_dmr.detection.detector import Candidate
from stream_dmr.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.simulation.film import film
from stream_dmr.simulation.rail_scene import make_scene
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings
from tests.support.frames import PAN_SIZE, frame_of, pan, texture

FISH_BGR = (200, 205, 210)


def draw_fish(image: np.ndarray, x: float, y: float, *, length: int = 60) -> np.ndarray:
    image = image.copy()
    axes = (length // 2, length // 6)
    cv2.ellipse(image, (round(x), round(y)), axes, 20, 0, 360, FISH_BGR, -1, cv2.LINE_AA)
    return image


def overlap(box: np.ndarray, other: np.ndarray) -> float:
    sides = np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2])
    inner = np.prod(np.maximum(sides, 0))
    areas = [np.prod(b[2:] - b[:2]) for b in (box, other)]
    return float(inner / (sum(areas) - inner))


def find_all(images: list[np.ndarray], **knobs: float) -> list[list[Candidate]]:
    detector = MotionDetector(MotionSettings.model_validate(knobs))
    return [detector.find(frame_of(image, i)) for i, image in enumerate(images, start=1)]


@pytest.mark.parametrize("step", [(0.0, 0.0), (2.0, 1.0), (-3.5, 0.7)])
def test_a_swimming_fish_is_found_whether_the_camera_rests_or_pans(step: tuple[float, float]):
    walls = pan(5, step, 24)
    places = [(60 + 8 * i, 60 + 4 * i) for i in range(24)]
    found = find_all([draw_fish(wall, *p) for wall, p in zip(walls, places, strict=True)])
    hits = 0
    for place, candidates in zip(places[6:], found[6:], strict=True):
        fish = draw_fish(np.zeros((*PAN_SIZE[::-1], 3), np.uint8), *place)[..., 0]
        x, y, w, h = cv2.boundingRect(fish)
        truth = np.array([x, y, x + w, y + h], float)
        hits += any(overlap(c.bbox_xyxy_px, truth) > 0.6 for c in candidates)
    assert hits >= 16
    assert sum(map(len, found[6:])) <= 20  # and little else


@pytest.mark.parametrize("step", [(0.0, 0.0), (2.0, 1.0), (-3.5, 0.7)])
def test_a_place_of_the_scene_stays_the_same_while_the_camera_pans(step: tuple[float, float]):
    detector, places = MotionDetector(MotionSettings()), []
    for i, wall in enumerate(pan(5, step, 24)):
        detector.find(frame_of(wall, i + 1))
        seen = np.array([150.0, 120.0]) - np.multiply(i, step)
        places.append(detector.scene_point(seen, shape=wall.shape))
    np.testing.assert_allclose(places[6:], np.broadcast_to(places[6], (18, 2)), atol=1.0)


def test_what_stands_still_is_no_fish():
    wall = texture(2)[:240, :320]
    stained = draw_fish(wall, 160, 120)
    assert not any(find_all([stained] * 6))
    found = find_all([wall] * 5 + [stained] * 12)
    assert any(found[5:9])  # it has just come
    assert not any(found[7:])


@pytest.mark.parametrize(("level", "is_found"), [(20, True), (90, False)])
def test_a_faint_fish_is_found_in_the_dark(level: int, is_found: bool):
    rng, pictures = np.random.default_rng(1), list[np.ndarray]()
    for i in range(60):
        picture = np.full((240, 320, 3), level, np.uint8)
        if i >= 30:
            cv2.ellipse(picture, (10 * i - 280, 120), (30, 10), 20, 0, 360, (level + 14,) * 3, -1)
        noisy = picture + rng.normal(0, 5, picture.shape)
        pictures.append(noisy.clip(0, 255).astype(np.uint8))
    found = find_all(pictures)
    assert not any(found[:30])
    assert (sum(map(bool, found[30:])) >= 25) == is_found


def test_a_change_of_light_is_no_fish():
    wall = texture(3)[:240, :320].astype(float)
    lit = [np.clip(wall * gain, 0, 255).astype(np.uint8) for gain in np.linspace(0.8, 1.2, 20)]
    assert not any(find_all(lit))


@pytest.mark.parametrize("before", [0.0, 0.25])
def test_after_a_black_picture_or_a_lamp_switched_on_fish_are_found_at_once(before: float):
    wall = texture(2)[:240, :320]
    dark = [(before * wall).astype(np.uint8)] * 8
    found = find_all([*dark, *(draw_fish(wall, 60 + 8 * i, 120) for i in range(16))])
    assert sum(len(candidates) == 1 for candidates in found[12:]) >= 10


def test_equal_pictures_give_equal_fish():
    pictures = [draw_fish(wall, 60 + 8 * i, 90) for i, wall in enumerate(pan(9, (2.0, 0.5), 12))]
    once, twice = find_all(pictures), find_all(pictures)
    for a, b in zip(once, twice, strict=True):
        assert [list(c.bbox_xyxy_px) for c in a] == [list(c.bbox_xyxy_px) for c in b]


def test_a_box_found_in_a_small_picture_is_where_the_fish_is_in_the_frame():
    wall = cv2.resize(texture(4), (1280, 960))
    pictures = [draw_fish(wall, 200 + 30 * i, 300, length=200) for i in range(10)]
    [candidate] = find_all(pictures, motion_working_px=320)[-1]
    fish = draw_fish(np.zeros_like(wall), 200 + 30 * 9, 300, length=200)[..., 0]
    x, y, w, h = cv2.boundingRect(fish)
    np.testing.assert_allclose(candidate.bbox_xyxy_px, [x, y, x + w, y + h], atol=10)
    x0, y0, x1, y1 = candidate.bbox_xyxy_px.astype(int)
    assert candidate.foreground is not None
    assert candidate.foreground.shape == (y1 - y0, x1 - x0)
    seen = fish[y0:y1, x0:x1] > 0
    assert (candidate.foreground & seen).sum() / (candidate.foreground | seen).sum() > 0.8


@pytest.mark.parametrize("preset", [pytest.param("realistic", marks=pytest.mark.slow), "severe"])
def test_the_fish_of_a_simulated_scene_are_found(preset: str):
    scene = make_scene(num_fish=2, num_frames=30, preset=preset, seed=3)
    detector = MotionDetector(MotionSettings())
    seen = found = alarms = 0
    for shot in film(scene):
        candidates = detector.find(frame_of(shot.image, shot.frame_index))
        truths = [np.array(b.xywh_px, float) for b in shot.boxes if b.visible_fraction > 0.8]
        boxes = [np.concatenate([t[:2], t[:2] + t[2:]]) for t in truths]
        hits = [any(overlap(c.bbox_xyxy_px, b) > 0.4 for c in candidates) for b in boxes]
        seen, found = seen + len(hits), found + sum(hits)
        alarms += max(0, len(candidates) - len(shot.boxes))
    assert seen > 20
    assert found >= 0.95 * seen
    assert alarms <= 1


@pytest.mark.scenes
def test_the_white_trout_of_the_real_clip_is_found(real):
    detector = MotionDetector(MotionSettings())
    source = open_source(str(real / "trout" / "fish.mp4"), ReadFramesSettings())
    # Read off the frames by eye: a fish that crosses the picture before a panning camera.
    truths = {70: [261, 23, 381, 95], 190: [287, 103, 400, 148], 250: [337, 72, 453, 115]}
    for frame in source:
        candidates = detector.find(frame)
        if frame.frame_index in truths:
            truth = np.array(truths[frame.frame_index], float)
            assert max(overlap(c.bbox_xyxy_px, truth) for c in candidates) > 0.5
        if frame.frame_index == max(truths):
            break
    source.close()
