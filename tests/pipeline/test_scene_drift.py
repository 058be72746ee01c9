"""Alarms of a moved camera and a fouled lens; none for sea, fish, noise and dusk."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.pipeline.config import DriftSettings
from stream_dmr.pipeline.drift import (
    SceneMonitor,
    compare_scenes,
    decode_scene,
    encode_scene,
    static_scene,
)

SECOND_NS = 10**9
SETTINGS = DriftSettings()
HEIGHT, WIDTH = 360, 480


def deck(*, shift: tuple[float, float] = (0, 0), blur: float = 0.0) -> np.ndarray:
    """Rail, posts and hull: what stands still."""
    image = np.full((HEIGHT, WIDTH), 70.0, np.float32)
    image[60:84] = 190
    for x in range(20, WIDTH, 90):
        image[84:330, x : x + 7] = 150
    image[200:212, 300:420] = 230
    image[330:] = 110
    image = cv2.warpAffine(
        image, np.array([[1, 0, shift[0]], [0, 1, shift[1]]], float), (WIDTH, HEIGHT), borderMode=1
    )
    return image if blur == 0 else cv2.GaussianBlur(image, (0, 0), blur)


def at_sea(rng: np.random.Generator, still: np.ndarray) -> np.ndarray:
    """The deck, with waves that roll where the sea is, a fish somewhere, and noise."""
    image = still.copy()
    waves = cv2.GaussianBlur(rng.normal(0, 160, (140, WIDTH)).astype(np.float32), (0, 0), 6)
    image[120:260] += np.where(image[120:260] == 70, waves, 0)
    at = (int(rng.integers(60, 420)), int(rng.integers(120, 300)))
    cv2.ellipse(image, at, (16, 60), float(rng.uniform(0, 180)), 0, 360, 30.0, thickness=-1)
    image += rng.normal(0, 3, image.shape)
    return cv2.cvtColor(np.clip(image, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def sample(monitor: SceneMonitor, still: np.ndarray, *, samples: int, first: int = 0) -> None:
    rng = np.random.default_rng(first)
    for k in range(first, first + samples):
        monitor.take(at_sea(rng, still), 5 * k * SECOND_NS)


def pictures(still: np.ndarray, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [cv2.cvtColor(at_sea(rng, still), cv2.COLOR_BGR2GRAY) for _ in range(9)]


@given(st.floats(-25, 25), st.floats(-25, 25), st.integers(0, 99))
@settings(max_examples=4)
def test_shift_is_measured_before_a_rolling_sea(x, y, seed):
    before = static_scene(pictures(deck(), seed), scale=2.0)
    now = static_scene(pictures(deck(shift=(x, y)), seed + 1000), scale=2.0)
    change = compare_scenes(before, now)
    assert change.shift_px == pytest.approx(2 * np.hypot(x, y), abs=1.5)
    assert 0.6 < change.sharpness < 1.4  # half a pixel softens edges


def test_sea_and_fish_raise_no_alarm():
    monitor = SceneMonitor(SETTINGS)
    for first in range(0, 40, 20):
        sample(monitor, deck(), samples=20, first=first)
        assert monitor.alarm == ""


@pytest.mark.parametrize(
    ("still", "words"),
    [(deck(shift=(9, -4)), "the camera seems bumped"), (deck(blur=4.0), "the lens seems fouled")],
)
def test_alarm_begins_and_ends_with_its_cause(still, words):
    monitor = SceneMonitor(SETTINGS)
    sample(monitor, deck(), samples=12)
    sample(monitor, still, samples=14, first=100)
    assert words in monitor.alarm
    sample(monitor, deck(), samples=14, first=200)
    assert monitor.alarm == ""


def test_scene_of_an_earlier_run_is_the_reference():
    earlier = SceneMonitor(SETTINGS)
    sample(earlier, deck(), samples=9)
    assert earlier.reference is not None
    kept = decode_scene(encode_scene(earlier.reference))
    assert kept is not None
    np.testing.assert_allclose(kept.edges, earlier.reference.edges, atol=1 / 512)
    monitor = SceneMonitor(SETTINGS, reference=kept)
    sample(monitor, deck(shift=(9, 0)), samples=14, first=300)  # bumped while it was off
    assert "bumped" in monitor.alarm


def test_night_raises_an_alarm_and_dusk_none():
    monitor = SceneMonitor(SETTINGS)
    sample(monitor, deck(), samples=12)
    sample(monitor, deck() * 0.4, samples=14, first=100)
    assert monitor.alarm == ""
    sample(monitor, deck() * 0, samples=14, first=200)
    assert monitor.alarm != ""


@given(st.binary(max_size=40))
def test_other_bytes_decode_to_none(data):
    assert decode_scene(data) is None


def test_frames_between_two_samples_are_skipped():
    monitor = SceneMonitor(SETTINGS)
    rng = np.random.default_rng(0)
    for k in range(40):
        monitor.take(at_sea(rng, deck()), k * SECOND_NS // 10)
    assert monitor.reference is None
