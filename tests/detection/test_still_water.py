"""Still water is passed over; what enters it is looked at at once, what hangs in it soon.

Repeated pictures show what they showed.
"""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from stream_dmr.detection.detector import Candidate
from stream_dmr.detection.fused_detector import FusedDetector, LookSettings
from stream_dmr.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.detection.still_water import StillWater
from stream_dmr.geometry import box_iou
from stream_dmr.messages import Frame
from stream_dmr.tracking.finder import TrackedFish, TrackFishSettings

WIDTH, HEIGHT, FPS = 320, 240, 10
SCENE = cv2.GaussianBlur(
    np.random.default_rng(1).integers(0, 255, (HEIGHT + 80, WIDTH + 80), np.uint8), (0, 0), 4
)
SCENE = cv2.cvtColor(cv2.normalize(SCENE, SCENE, 50, 130, cv2.NORM_MINMAX), cv2.COLOR_GRAY2BGR)
NOISE = np.random.default_rng(2).normal(0, 3, (HEIGHT + 80, WIDTH + 80, 3)).round().astype(np.int16)


def water(num: int, *, shift: float = 0.0, light: float = 0.0) -> Iterator[np.ndarray]:
    """Pictures with noise of a camera that shakes by `shift` px, in light that changes."""
    rng = np.random.default_rng(3)
    for i in range(num):
        x, y = np.round(40 + rng.uniform(-shift, shift, 2)).astype(int)
        u, v = rng.integers(80, size=2)
        noise = NOISE[v : v + HEIGHT, u : u + WIDTH] + np.int16(light * np.sin(i / 10))
        yield cv2.add(SCENE[y : y + HEIGHT, x : x + WIDTH], noise, dtype=cv2.CV_8U)


def draw_fish(picture: np.ndarray, middle: tuple[int, int]) -> np.ndarray:
    return cv2.ellipse(picture.copy(), middle, (30, 11), 0, 0, 360, (215, 215, 205), -1)


def shares_that_change(still: StillWater, pictures: Iterator[np.ndarray]) -> float:
    return float(np.mean([still.changes(one, is_empty=True) for one in pictures]))


@pytest.mark.parametrize("light", [0.0, 15.0])
def test_still_water_is_passed_over_until_a_fish_looks_in(light):
    still = StillWater()
    pictures = [*water(120, light=light)]
    changed = [still.changes(one, is_empty=True) for one in pictures[:-1]]
    assert all(changed[:10])
    assert np.mean(changed[30:]) < 0.15
    assert still.changes(draw_fish(pictures[-1], (-18, 120)), is_empty=True)  # its snout


def test_a_moving_camera_ends_neither_for_good():
    still = StillWater()
    shares_that_change(still, water(60))
    assert all(still.changes(one, is_empty=True) for one in [*water(8, shift=12.0)][3:])
    shares_that_change(still, water(250, shift=12.0))
    assert shares_that_change(still, water(50, shift=12.0)) < 0.5
    shares_that_change(still, water(150))
    assert shares_that_change(still, water(49)) < 0.15
    assert still.changes(draw_fish(next(water(1)), (0, 120)), is_empty=True)


class BrightLooks:
    """Finds what is bright, and counts how often it looked."""

    def __init__(self) -> None:
        self.refused: dict[str, int] = {}
        self.looks = 0

    def find(self, frame: Frame) -> list[Candidate]:
        self.looks += 1
        bright = cv2.morphologyEx(
            (frame.image.min(axis=2) > 180).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3))
        )
        x, y, w, h = cv2.boundingRect(bright)
        box = np.array([x, y, x + w, y + h], np.float64)
        return [Candidate(bbox_xyxy_px=box, score=0.9)] if w * h else []


def seen_in(pictures: list[np.ndarray], every_s: float) -> tuple[list[np.ndarray | None], int]:
    """The box in each picture, and how many of them the network looked at."""
    looks = BrightLooks()
    detector = FusedDetector(
        MotionDetector(MotionSettings()), looks, LookSettings(look_every_s=every_s)
    )
    finder = TrackedFish(detector, TrackFishSettings())
    boxes: list[np.ndarray | None] = []
    for i, image in enumerate(pictures, start=1):
        frame = Frame(frame_index=i, timestamp_ns=i * 10**9 // FPS, image=image, source="")
        found = finder.detect(frame)
        assert len(found) <= 1
        boxes.append(found[0].bbox_xyxy_px if found else None)
    return boxes, looks.looks


def test_a_fish_that_hangs_still_is_seen_within_the_time_that_is_set(monkeypatch):
    # As where it comes so slowly that it is no change.
    monkeypatch.setattr(StillWater, "changes", lambda self, image, is_empty: False)
    monkeypatch.setattr(StillWater, "is_new", False)
    came = 43
    pictures = [*water(70)]
    pictures[came:] = [draw_fish(one, (160, 120)) for one in pictures[came:]]
    boxes, looks = seen_in(pictures, every_s=0.5)
    first = next(i for i, box in enumerate(boxes) if box is not None)
    assert came <= first < came + 0.5 * FPS
    assert all(box is not None for box in boxes[first:])  # from then on in every picture
    assert looks <= came / (0.5 * FPS) + 1 + len(pictures) - first


def test_the_same_fish_are_found_as_by_looking_at_every_picture():
    pictures = [*water(160)]
    for start in (60, 110):  # one from the left, then one from the right
        for i in range(36):
            x = -20 + 10 * i if start == 60 else WIDTH + 20 - 10 * i
            pictures[start + i] = draw_fish(pictures[start + i], (x, 120))
    by_all, all_looks = seen_in(pictures, every_s=0.0)
    by_some, some_looks = seen_in(pictures, every_s=0.5)
    assert some_looks < 0.8 * all_looks
    assert [box is None for box in by_all] == [box is None for box in by_some]
    pairs = [(a, b) for a, b in zip(by_all, by_some, strict=True) if a is not None]
    assert len(pairs) > 60
    assert all(box_iou(a, b) > 0.95 for a, b in pairs if b is not None)


def crossing(num: int) -> list[np.ndarray]:
    return [draw_fish(one, (40 + 8 * i, 120)) for i, one in enumerate(water(num))]


@pytest.mark.parametrize("times", [2, 3])
def test_pictures_that_a_recorder_repeats_show_what_they_showed(times: int):
    rng = np.random.default_rng(0)
    pictures = [
        cv2.add(picture, rng.integers(-2, 3, picture.shape, np.int16), dtype=cv2.CV_8U)
        for picture in crossing(24)
        for _ in range(times)
    ]
    once, _ = seen_in(pictures[::times], every_s=0.5)
    repeated, _ = seen_in(pictures, every_s=0.5)
    assert sum(box is not None for box in once) > 15
    for i, box in enumerate(repeated):
        np.testing.assert_array_equal(box, once[i // times])
