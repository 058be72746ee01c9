"""Random fish: closed index ranges, in front of the camera, of every kind."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.training.random_fish import draw_shape, pose_shape

seeds = st.integers(0, 10**6)


@given(seeds)
def test_a_straight_fish_is_one_body_length_long(seed: int):
    shape = draw_shape(np.random.default_rng(seed))
    assert shape.faces.min() >= 0
    assert shape.faces.max() < len(shape.points)
    along = shape.points[:, 0]
    assert 0 <= along.min() < 0.01
    assert 0.95 < along.max() < 1.2  # forks and rounded tails
    assert np.abs(shape.points[:, 1]).max() < 0.5
    assert len(shape.texture) == len(shape.is_fin) == len(shape.points)


@given(seeds)
def test_a_posed_fish_is_before_the_camera_and_no_longer_than_straight(seed: int):
    rng = np.random.default_rng(seed)
    shape = draw_shape(rng)
    posed = pose_shape(rng, shape)
    assert posed.vertices[:, 2].min() > 1
    assert posed.vertices.shape == shape.points.shape
    assert np.linalg.norm(posed.ends[1] - posed.ends[0]) <= 1 + 1e-9


def test_both_kinds_of_fish_are_drawn():
    kinds = [draw_shape(np.random.default_rng(seed)).is_flatfish for seed in range(60)]
    assert np.mean(kinds) == pytest.approx(0.45, abs=0.2)
