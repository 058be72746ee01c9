"""Weather and camera change colours, not places."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.training.image_degradation import add_weather, motion_kernel, simulate_camera

seeds = st.integers(0, 10**6)


def half_bright() -> np.ndarray:
    picture = np.full((64, 64, 3), 60, np.float32)
    picture[:, 32:] = 180
    return picture


@given(seeds, st.floats(0.5, 12))
def test_a_motion_kernel_keeps_brightness_and_place(seed: int, length_px: float):
    kernel = motion_kernel(np.random.default_rng(seed), length_px)
    assert kernel.sum() == pytest.approx(1)
    rows, columns = np.indices(kernel.shape)
    half = len(kernel) // 2
    for axis in (rows, columns):
        assert (kernel * axis).sum() == pytest.approx(half, abs=0.5)
    assert np.hypot(*(np.argwhere(kernel > 0) - half).T).max() <= length_px / 2 + 0.75


@given(seeds)
def test_equal_seeds_give_equal_photographs_of_the_same_size(seed: int):
    one, other = (
        simulate_camera(rng, add_weather(rng, half_bright()))
        for rng in (np.random.default_rng(seed), np.random.default_rng(seed))
    )
    np.testing.assert_array_equal(one, other)
    assert (one.dtype, one.shape) == (np.uint8, (64, 64, 3))


def test_the_bright_half_stays_the_bright_half():
    brighter = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        pixels = simulate_camera(rng, add_weather(rng, half_bright())).astype(float)
        brighter.append(pixels[:, 34:].mean() - pixels[:, :30].mean())
    assert np.mean(np.array(brighter) > 0) == 1


def test_two_in_five_pictures_have_no_weather():
    same = [
        (add_weather(np.random.default_rng(seed), half_bright()) == half_bright()).all()
        for seed in range(300)
    ]
    assert 0.4 <= np.mean(same) < 0.62  # 0.6 * 0.65 * 0.75 * ... of the others have none either
