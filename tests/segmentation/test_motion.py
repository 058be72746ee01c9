"""The detector that needs no weights: what moves before a background that follows the camera."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.background_model import BackgroundModel
from stream_dmr.segmentation.detection.blobs import fish_blobs
from stream_dmr.segmentation.detection.camera_motion import CameraMotion, compose
from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.segmentation.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.simulation.backdrop import Backdrop
from stream_dmr.simulation.film import film
from stream_dmr.simulation.rail_scene import make_scene
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.read_settings import ReadFramesSettings

SIZE = (320, 240)
FISH_BGR = (200, 205, 210)


def texture(seed: int, *, width: int = 640, height: int = 480, grain: float = 3.0) -> np.ndarray:
    """A rock face: coloured noise that stands still."""
    rng = np.random.default_rng(seed)
    layers = rng.normal(0, 1, (height, width, 3)).astype(np.float32)
    layers = cv2.GaussianBlur(layers, (0, 0), grain)
    return np.clip(110 + 30 * layers / layers.std(), 0, 255).astype(np.uint8)


def frame_of(image: np.ndarray, index: int) -> Frame:
    return Frame(frame_index=index, timestamp_ns=index, image=image, source="test")


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


def pan(seed: int, step: tuple[float, float], frames: int) -> list[np.ndarray]:
    """A camera that moves before a rock face, by so much a frame."""
    wall = texture(seed)
    pictures = []
    for i in range(frames):
        affine = np.array([[1.0, 0.0, -100 - i * step[0]], [0.0, 1.0, -100 - i * step[1]]])
        pictures.append(cv2.warpAffine(wall, affine, SIZE, borderMode=cv2.BORDER_REFLECT))
    return pictures


def grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


@given(st.integers(0, 99))
@settings(max_examples=5)
def test_the_background_is_judged_and_learnt_as_its_formulas_say(seed: int):
    """The compiled arithmetic against the same in plain arrays."""
    rng = np.random.default_rng(seed)
    first, second, third = (rng.uniform(0, 255, (3, 24, 32)).astype(np.float32) for _ in range(3))
    background = BackgroundModel(first, memory_frames=5.0)
    background.learn(second, background.distance(second), np.ones((24, 32), np.float32))
    away = third - background.mean - background._light
    bb, gg, rr, bg, br, gr = background._precision
    inverse = np.array([[bb, bg, br], [bg, gg, gr], [br, gr, rr]])
    expected = np.einsum("ihw,ijhw,jhw->hw", away, inverse, away) / background._variance_ratio
    distance = background.distance(third)
    np.testing.assert_allclose(distance, expected, rtol=2e-3)
    rate = rng.choice([0.0, 0.5, 1.0], (24, 32)).astype(np.float32)
    speed = rate * np.maximum(1 / (background._age + 1), 1 / 5)
    excess = np.clip(distance * background._variance_ratio / 3, 1, 8)
    habit = background._variance_ratio + speed * (excess - background._variance_ratio)
    mean = background.mean + speed * (third - background.mean)
    age = background._age + (rate > 0)
    background.learn(third, distance, rate)
    for found, wanted in ((background.mean, mean), (background._variance_ratio, habit)):
        np.testing.assert_allclose(found, wanted, rtol=1e-4)
    np.testing.assert_array_equal(background._age, age)


@given(st.integers(0, 99), st.floats(-6, 6), st.floats(-6, 6))
@settings(max_examples=15)
def test_a_panning_camera_is_followed(seed: int, dx: float, dy: float):
    camera = CameraMotion()
    everywhere = np.ones(SIZE[::-1], bool)
    pictures = pan(seed, (dx, dy), 6)
    found = [camera.step(grey(picture), is_background=everywhere) for picture in pictures]
    if max(abs(dx), abs(dy)) < 0.75:
        return  # may pass for rest
    for affine in found[1:]:
        assert affine is not None
        np.testing.assert_allclose(affine[:, 2], [-dx, -dy], atol=0.25)


def test_a_sea_that_drifts_before_a_resting_rail_is_no_camera_that_moves():
    for seed in range(3):
        sea = Backdrop(np.random.default_rng(seed), width=640, height=480)
        camera = CameraMotion()
        for i in range(12):
            picture = cv2.resize(grey(sea.draw(i)), (480, 360), interpolation=cv2.INTER_AREA)
            assert camera.step(picture, is_background=np.ones(picture.shape, bool)) is None


@given(st.floats(-3, 3), st.floats(-20, 20), st.floats(0.8, 1.2))
def test_motions_compose_as_they_act(turn: float, shift: float, scale: float):
    first = np.array([[scale, -turn, shift], [turn, scale, -shift]])
    second = np.array([[1.0, 0.1, 3.0], [-0.1, 1.0, shift]])
    point = np.array([7.0, -2.0, 1.0])
    expected = second @ [*(first @ point), 1.0]
    np.testing.assert_allclose(compose(second, first) @ point, expected, atol=1e-9)


@pytest.mark.parametrize("step", [(0.0, 0.0), (2.0, 1.0), (-3.5, 0.7)])
def test_a_swimming_fish_is_found_whether_the_camera_rests_or_pans(step: tuple[float, float]):
    walls = pan(5, step, 24)
    places = [(60 + 8 * i, 60 + 4 * i) for i in range(24)]
    found = find_all([draw_fish(wall, *p) for wall, p in zip(walls, places, strict=True)])
    hits = 0
    for place, candidates in zip(places[6:], found[6:], strict=True):
        fish = draw_fish(np.zeros((*SIZE[::-1], 3), np.uint8), *place)[..., 0]
        x, y, w, h = cv2.boundingRect(fish)
        truth = np.array([x, y, x + w, y + h], float)
        hits += any(overlap(c.bbox_xyxy_px, truth) > 0.6 for c in candidates)
    assert hits >= 16
    assert sum(map(len, found[6:])) <= 20  # and little else


def test_what_stands_still_is_no_fish():
    wall = texture(2)[:240, :320]
    stained = draw_fish(wall, 160, 120)
    assert not any(find_all([stained] * 6))
    found = find_all([wall] * 5 + [stained] * 6)
    assert found[5]  # it has just come
    assert not any(found[6:])


def test_nothing_is_found_where_nothing_moves_but_light():
    wall = texture(3)[:240, :320].astype(float)
    lit = [np.clip(wall * gain, 0, 255).astype(np.uint8) for gain in np.linspace(0.8, 1.2, 20)]
    assert not any(find_all(lit))


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


def drawn(draw: Callable[[np.ndarray], object]) -> list[np.ndarray]:
    picture = np.zeros((360, 480), np.uint8)
    draw(picture)
    return fish_blobs(picture > 0, min_length_px=15.0, max_length_px=340.0)


def test_lines_poles_and_specks_are_no_fish():
    assert not drawn(lambda p: cv2.line(p, (200, 0), (220, 180), 1, 2))
    assert not drawn(lambda p: cv2.line(p, (479, 10), (250, 170), 1, 6))
    assert not drawn(lambda p: cv2.circle(p, (100, 100), 4, 1, -1))
    assert not drawn(lambda p: cv2.rectangle(p, (20, 0), (460, 355), 1, -1))


def test_a_fish_is_freed_of_the_gaff_and_the_line():
    def draw(picture: np.ndarray) -> None:
        cv2.ellipse(picture, (200, 200), (40, 14), 70, 0, 360, 1, -1)
        cv2.line(picture, (479, 60), (205, 205), 1, 5)

    [fish] = drawn(draw)
    x, y, w, h = cv2.boundingRect(fish.view(np.uint8))
    assert 160 < x < 190
    assert x + w < 260
    assert 150 < y < 165
    assert 235 < y + h < 245


def test_a_fish_seen_edge_on_is_whole_whatever_its_bend():
    for width in (6, 8, 10, 12):
        [fish] = drawn(lambda p, w=width: cv2.ellipse(p, (200, 200), (60, 40), 0, 0, 110, 1, w))
        _, _, w, h = cv2.boundingRect(fish.view(np.uint8))
        assert w > 75
        assert h > 38


def test_a_fish_seen_edge_on_counts():
    [fish] = drawn(lambda p: cv2.ellipse(p, (200, 200), (35, 3), 70, 0, 360, 1, -1))
    assert fish.sum() > 200


@pytest.mark.parametrize("preset", ["realistic", "severe"])
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
