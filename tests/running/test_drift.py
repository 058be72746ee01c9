"""Alarms: a bumped camera, a fouled lens, fits that get worse; and none without a cause."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.running.drift import (
    FitWatch,
    SceneWatch,
    compare,
    decode_scene,
    encode_scene,
    scene_of,
)
from stream_dmr.running.run_settings import DriftSettings

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


def watch(watched: SceneWatch, still: np.ndarray, *, samples: int, first: int = 0) -> None:
    rng = np.random.default_rng(first)
    for k in range(first, first + samples):
        watched.take(at_sea(rng, still), 5 * k * SECOND_NS)


def pictures(still: np.ndarray, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [cv2.cvtColor(at_sea(rng, still), cv2.COLOR_BGR2GRAY) for _ in range(9)]


@given(st.floats(-25, 25), st.floats(-25, 25), st.integers(0, 99))
@settings(max_examples=8)
def test_a_shift_is_measured_before_a_rolling_sea(x, y, seed):
    before = scene_of(pictures(deck(), seed), scale=2.0)
    now = scene_of(pictures(deck(shift=(x, y)), seed + 1000), scale=2.0)
    change = compare(before, now)
    assert change.shift_px == pytest.approx(2 * np.hypot(x, y), abs=1.5)
    assert 0.6 < change.sharpness < 1.4  # half a pixel softens edges


def test_hours_of_sea_and_fish_are_no_alarm():
    watched = SceneWatch(SETTINGS)
    for first in range(0, 40, 20):
        watch(watched, deck(), samples=20, first=first)
        assert watched.alarm == ""


@pytest.mark.parametrize(
    ("still", "words"),
    [(deck(shift=(9, -4)), "the camera seems bumped"), (deck(blur=4.0), "the lens seems fouled")],
)
def test_an_alarm_comes_with_its_cause_and_goes_with_it(still, words):
    watched = SceneWatch(SETTINGS)
    watch(watched, deck(), samples=12)
    watch(watched, still, samples=14, first=100)
    assert words in watched.alarm
    watch(watched, deck(), samples=14, first=200)
    assert watched.alarm == ""


def test_the_scene_of_an_earlier_run_is_what_counts():
    earlier = SceneWatch(SETTINGS)
    watch(earlier, deck(), samples=9)
    assert earlier.reference is not None
    kept = decode_scene(encode_scene(earlier.reference))
    assert kept is not None
    np.testing.assert_allclose(kept.edges, earlier.reference.edges, atol=1 / 512)
    watched = SceneWatch(SETTINGS, reference=kept)
    watch(watched, deck(shift=(9, 0)), samples=14, first=300)  # bumped while it was off
    assert "bumped" in watched.alarm


def test_dusk_is_no_alarm_and_night_is_one():
    watched = SceneWatch(SETTINGS)
    watch(watched, deck(), samples=12)
    watch(watched, deck() * 0.4, samples=14, first=100)
    assert watched.alarm == ""
    watch(watched, deck() * 0, samples=14, first=200)
    assert watched.alarm != ""


@given(st.binary(max_size=40))
def test_other_bytes_are_no_scene(data):
    assert decode_scene(data) is None


def test_between_two_samples_nothing_is_looked_at():
    watched = SceneWatch(SETTINGS)
    rng = np.random.default_rng(0)
    for k in range(40):
        watched.take(at_sea(rng, deck()), k * SECOND_NS // 10)
    assert watched.reference is None


def test_fits_that_get_worse_are_an_alarm_and_chance_is_none():
    rng = np.random.default_rng(5)
    for seed in range(20):
        fits = FitWatch(SETTINGS)
        for iou in np.random.default_rng(seed).normal(0.93, 0.02, 300):
            fits.take(float(iou))
            assert fits.alarm == ""
    for iou in rng.normal(0.89, 0.03, 40):
        fits.take(float(iou))
    assert "meshes fit worse than at first" in fits.alarm
    for iou in rng.normal(0.93, 0.02, 40):
        fits.take(float(iou))
    assert fits.alarm == ""
