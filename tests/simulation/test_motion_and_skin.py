"""Motion and skin of simulated fish: repeatable, smooth, and within what a preset says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.simulation.rail_scene import FPS, PRESETS, draw_poses, find_preset
from stream_dmr.simulation.simulated_fish import draw_skin, noise, total_bend_rad

seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=20)
@given(seed=seeds, name=st.sampled_from(sorted(PRESETS)), num_frames=st.integers(1, 40))
def test_poses_bend_no_more_than_their_preset_and_move_smoothly(seed, name, num_frames):
    preset = find_preset(name)
    rng = np.random.default_rng(seed)
    poses = draw_poses(rng, preset, lane_mm=300.0, num_frames=num_frames)
    assert len(poses) == num_frames
    assert max(total_bend_rad(p.bends) for p in poses) <= np.radians(preset.max_bend_deg) * 1.001
    assert max(abs(p.center_world_mm[2]) for p in poses) <= 25.0
    steps = np.abs(np.diff([p.yaw_rad for p in poses]))
    fastest = 2 * np.pi * 0.8 * np.radians(preset.yaw_deg) * np.sqrt(6) / FPS
    assert (steps <= fastest + 1e-9).all()


def test_a_fish_is_hauled_upwards():
    poses = draw_poses(np.random.default_rng(1), find_preset("clean"), lane_mm=0.0, num_frames=30)
    heights = np.array([pose.center_world_mm[1] for pose in poses])  # Y points down
    assert (np.diff(heights) < 0).all()


@pytest.mark.parametrize("grain_px", [(1.5, 1.5), (5.0, 14.0), (30.0, 12.0)])
def test_noise_has_unit_variance_and_its_grain(grain_px: tuple[float, float]):
    texture = noise(np.random.default_rng(3), 300, 400, grain_px=grain_px)
    assert texture.shape == (300, 400)
    np.testing.assert_allclose([texture.mean(), texture.std()], [0.0, 1.0], atol=1e-4)
    for axis, grain in ((1, grain_px[0]), (0, grain_px[1])):
        lag = max(1, round(grain / 2))
        near = np.take(texture, range(lag, texture.shape[axis]), axis)
        far = np.take(texture, range(texture.shape[axis] - lag), axis)
        assert np.mean(near * far) > 0.7


def test_each_fish_has_its_own_skin_and_a_pale_blind_side():
    skin = draw_skin(seed=1, track_id=1)
    np.testing.assert_array_equal(skin, draw_skin(seed=1, track_id=1))
    assert not np.array_equal(skin, draw_skin(seed=1, track_id=2))
    eyed, blind = skin
    assert blind.mean() > 2 * eyed.mean()
    assert skin.min() >= 0
    assert skin.max() <= 255
