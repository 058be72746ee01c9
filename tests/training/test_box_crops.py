"""Crops leave their margin; boxes with errors stay boxes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.training.samples import crop_affine, draw_part_box, jitter_box

numbers = st.floats(-50, 200)

sides = st.floats(1, 150)


@given(numbers, numbers, sides, sides, st.floats(0, 0.5))
def test_a_crop_leaves_its_margin_around_the_longer_side(x, y, w, h, margin):
    crop = crop_affine(np.array([x, y, x + w, y + h]), margin=margin, size=64)
    low, high = (crop[:, :2] @ np.array([[x, x + w], [y, y + h]]) + crop[:, 2:]).T
    edges = np.concatenate([low, 63 - high])  # to the first and last pixel centres
    assert edges.min() == pytest.approx(64 * margin / (1 + 2 * margin) - 0.5, abs=1e-6)
    np.testing.assert_allclose(low + high, 63, atol=1e-6)


@given(st.integers(0, 10**6), numbers, numbers, sides, sides)
def test_a_jittered_box_stays_in_its_limits_and_is_a_box(seed, x, y, w, h):
    limits = np.array([x - 1, y - 1, x + w + 1, y + h + 1])
    moved = jitter_box(np.random.default_rng(seed), np.array([x, y, x + w, y + h]), limits=limits)
    assert (moved[:2] >= limits[:2]).all()
    assert (moved[2:] <= limits[2:]).all()
    assert (moved[2:] > moved[:2]).all()


@given(st.integers(0, 10**6), numbers, numbers, sides, sides)
def test_the_box_of_a_part_lies_in_the_whole_box(seed, x, y, w, h):
    box = np.array([x, y, x + w, y + h])
    points = box[:2] + np.random.default_rng(1).random((20, 2)) * [w, h]
    part = draw_part_box(np.random.default_rng(seed), box, points)
    assert (part[:2] >= box[:2] - 1e-9).all()
    assert (part[2:] <= box[2:] + 1e-9).all()
    shares = (part[2:] - part[:2]) / [w, h]
    assert ((shares > 0.24) & (shares < 0.61)).all()
    assert any((part[:2] <= point).all() and (point <= part[2:]).all() for point in points)
