"""Occluders are drawn where they are, at any scale."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.training.surroundings import (
    Occluder,
    draw_board,
    draw_into,
    draw_line,
    draw_occluders,
    draw_ruler,
)

SIZE = 96


def square(x: float, y: float, side: float, *, tones: list[float]) -> Occluder:
    """Squares of this side on top of each other, one per tone."""
    polygon = np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])
    polygons = [polygon] * len(tones)
    return Occluder(polygons=polygons, tones=tones, colour=np.zeros(3), hides=True)


@given(st.floats(-0.5, 0.2), st.floats(-0.5, 0.2), st.floats(0.2, 0.3), st.floats(50, 90))
def test_a_polygon_covers_its_area(x: float, y: float, side: float, scale: float):
    crop_from_scene = np.array([[scale, 0.0, 48.0], [0.0, scale, 48.0]])
    covered, _ = draw_into(square(x, y, side, tones=[1.0]), crop_from_scene, size=SIZE)
    side_px = scale * side
    # OpenCV draws a polygon's outline as part of it, half a pixel wide on each side
    assert covered.sum() == pytest.approx((side_px + 1) ** 2, rel=0.2)
    assert 0 <= covered.min() <= covered.max() <= 1
    rows, columns = np.nonzero(covered > 0.5)
    middle = np.array([x + side / 2, y + side / 2]) * scale + 48
    np.testing.assert_allclose([columns.mean(), rows.mean()], middle, atol=0.75)


def test_later_polygons_lie_over_earlier_ones():
    crop_from_scene = np.array([[50.0, 0.0, 48.0], [0.0, 50.0, 48.0]])
    _, tones = draw_into(square(-0.3, -0.3, 0.6, tones=[0.5, 1.5]), crop_from_scene, size=SIZE)
    assert tones[48, 48] == pytest.approx(1.5)
    assert tones[2, 2] == 1  # outside


def test_a_line_leaves_upwards_from_its_start_and_hides_nothing():
    start = np.array([0.1, 0.2])
    for seed in range(20):
        line = draw_line(np.random.default_rng(seed), start)
        assert not line.hides
        bar = line.polygons[0]
        assert np.linalg.norm(bar - start, axis=1).min() < 0.03
        assert bar[:, 1].min() < -1.5


def test_most_scenes_have_no_occluder():
    counts = [len(draw_occluders(np.random.default_rng(seed))) for seed in range(400)]
    assert np.mean([count == 0 for count in counts]) == pytest.approx(0.59, abs=0.08)
    assert max(counts) <= 4


def test_a_ruler_lies_beside_the_fish_and_along_it():
    for seed in range(40):
        along_rad = seed * 0.3
        ruler = draw_ruler(np.random.default_rng(seed), along_rad)
        across = np.array([-np.sin(along_rad), np.cos(along_rad)])
        beside = np.concatenate(ruler.polygons).mean(axis=0) @ across
        assert 0.03 < abs(beside) < 0.6
        extent = np.ptp(ruler.polygons[0] @ across), np.ptp(ruler.polygons[0], axis=0).max()
        assert extent[0] < extent[1]
        assert all(1 < len(polygon) < 5 for polygon in ruler.polygons)


def test_a_board_lies_under_the_fish_and_along_it():
    for seed in range(40):
        along_rad = seed * 0.3
        floor = draw_board(np.random.default_rng(seed), along_rad)[0].polygons[0]
        along = np.array([np.cos(along_rad), np.sin(along_rad)])
        across = np.array([-np.sin(along_rad), np.cos(along_rad)])
        assert (floor @ across).min() < 0 < (floor @ across).max()
        assert np.ptp(floor @ along) > 0.9  # about as long as the fish, or longer
        assert np.ptp(floor @ along) > np.ptp(floor @ across)


def test_marks_of_a_board_are_on_it():
    crop_from_scene = np.array([[30.0, 0.0, 48.0], [0.0, 30.0, 48.0]])
    for seed in range(20):
        floor, *prints = draw_board(np.random.default_rng(seed), 0.0)
        board, _ = draw_into(floor, crop_from_scene, size=SIZE)
        for thing in prints:
            covered, _ = draw_into(thing, crop_from_scene, size=SIZE)
            assert (covered * (board > 0.5)).sum() > 0.5 * covered.sum()
