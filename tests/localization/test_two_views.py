"""Two cameras: a curve seen by both has its true length, wherever the plane and the start are."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.geometry import arc_length
from stream_dmr.localization.two_views import (
    View,
    agreed,
    place_between,
    rays_apart,
    second_from_first,
)
from stream_dmr.simulation.rail_scene import second_camera

FIRST = Calibration(
    camera=Camera(
        width=1280,
        height=960,
        K=np.array([[1300.0, 0, 640], [0, 1295.0, 470], [0, 0, 1]]),
        distortion=np.array([-0.06, 0.01, 1e-4, 1e-4, 0]),
    ),
    plane=ReferencePlane(
        rotation=cv2.Rodrigues(np.array([0.1, -0.2, 0.03]))[0],
        translation_mm=np.array([50.0, -20.0, 5000.0]),
    ),
)


def bent_fish(bend_rad: float, turn: np.ndarray, length_mm: float = 700.0) -> np.ndarray:
    """An arc off the plane, mm in the first camera's frame; it hangs upright unless turned."""
    angles = bend_rad * (np.linspace(0, 1, 65) - 0.5)
    steps = np.column_stack([np.sin(angles), np.cos(angles), 0.3 * np.sin(2 * angles)])
    line = np.cumsum(steps, axis=0)
    line = (line - line.mean(axis=0)) * (length_mm / arc_length(line))
    return line @ cv2.Rodrigues(turn)[0].T + [120.0, -60.0, 4800.0]


def seen(line_mm: np.ndarray, degrees: float) -> tuple[View, View]:
    second = second_camera(FIRST, degrees=degrees)
    R, t = second_from_first(FIRST, second)
    lines = ((FIRST, line_mm), (second, line_mm @ R.T + t))
    first, second = (
        View(px := one.camera.project(line), px[len(px) // 2], one) for one, line in lines
    )
    return first, second


@given(
    st.floats(0, 2.0),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    st.sampled_from([15.0, 35.0, 60.0, -90.0]),
    st.floats(0.8, 1.25),
)
def test_a_bent_fish_has_its_length_from_any_start(bend_rad, turn, degrees, scale):
    line = bent_fish(bend_rad, np.array(turn))
    flat = line * [1, 1, 0] + [0, 0, line[:, 2].mean()]  # as if it hung in a plane, at any size
    placed = place_between(seen(line, degrees), flat * scale)
    assert placed.length_mm == pytest.approx(700, rel=4e-3)
    assert placed.misfit < 0.3
    gaps = np.linalg.norm(placed.midline_mm[:, None] - line, axis=2).min(axis=1)
    assert gaps.max() < 15  # mm beside the body's midline
    assert 0 < placed.length_std_mm < 30


def test_the_std_is_that_of_errors_along_and_across():
    line = bent_fish(0.8, np.array([0.2, 0.1, 0.2]))
    views = seen(line, 35.0)
    rng = np.random.default_rng(0)
    lengths, stds = [], []
    for _ in range(60):
        noisy = []
        for view in views:  # the ends slide along the body by 0.7 % of the length
            px, size = view.midline_px.copy(), arc_length(view.midline_px)
            slide = 0.007 * size * rng.normal(size=2)
            place = np.linspace(slide[0], size + slide[1], len(px))
            arc = np.linspace(0, size, len(px))
            moved = np.column_stack([np.interp(place, arc, axis) for axis in px.T])
            for end, tangent in ((0, px[0] - px[1]), (-1, px[-1] - px[-2])):
                beyond = -place[0] if end == 0 else place[-1] - size
                moved[end] += max(beyond, 0) * tangent / np.linalg.norm(tangent)
            noisy.append(view._replace(midline_px=moved))
        placed = place_between((noisy[0], noisy[1]), line)
        lengths.append(placed.length_mm)
        stds.append(placed.length_std_mm)
    assert 0.6 < np.std(lengths) / np.mean(stds) < 1.4


@pytest.mark.parametrize("short", [0, 1])
@pytest.mark.parametrize("degrees", [35.0, 60.0, 90.0])
def test_a_tail_that_one_camera_leaves_out_is_taken_from_the_other(degrees, short):
    """Seen on edge, a fit leaves out the tail, and covers less of its mask."""
    line = bent_fish(0.5, np.array([0.1, 0.1, 0.1]))
    views = [*seen(line, degrees)]
    good = place_between((views[0], views[1]), line)
    px = views[short].midline_px
    views[short] = views[short]._replace(midline_px=px[: round(0.85 * len(px))], iou=0.88)
    placed = place_between((views[0], views[1]), line)
    assert placed.length_mm == pytest.approx(700, rel=0.02)
    assert placed.length_std_mm > 2 * good.length_std_mm
    assert placed.misfit > 1


@pytest.mark.parametrize("share", [-0.02, 0.02])
def test_a_picture_that_is_shifted_along_the_body_makes_no_fish_longer(share):
    """As by cameras that are not quite in step."""
    line = bent_fish(0.5, np.array([0.1, 0.1, 0.1]))
    first, second = seen(line, 35.0)
    shift = share * (second.midline_px[-1] - second.midline_px[0])
    placed = place_between((first, second._replace(midline_px=second.midline_px + shift)), line)
    assert placed.length_mm == pytest.approx(700, rel=3e-3)


def test_what_both_pictures_leave_out_is_short_and_no_contradiction():
    line = bent_fish(0.5, np.array([0.1, 0.1, 0.1]))
    views = seen(line[:-6], 35.0)
    placed = place_between(views, line)
    assert placed.length_mm == pytest.approx(arc_length(line[:-6]), rel=5e-3)
    assert placed.misfit < 0.3


@pytest.mark.parametrize("short", [8, 16])
def test_a_tail_in_neither_picture_is_taken_from_the_mesh_that_knows_of_it(short):
    """A fish's own body may hide its tail from both: then nothing in the pictures contradicts."""
    line = bent_fish(0.5, np.array([0.1, 0.1, 0.1]))
    curve = place_between(seen(line[:-short], 35.0), line)
    placed = agreed(curve, line, 0.93)
    assert placed.length_mm == pytest.approx(700, rel=0.01)
    assert placed.length_std_mm > 2 * curve.length_std_mm
    assert arc_length(placed.midline_mm) == pytest.approx(placed.length_mm)


@given(st.floats(0.5, 1.0), st.floats(-0.1, 0.1))
def test_the_common_length_lies_between_the_two_and_nearer_to_the_surer(iou, longer):
    line = bent_fish(0.5, np.array([0.1, 0.1, 0.1]))
    curve = place_between(seen(line, 35.0), line)
    mesh = line * np.exp(longer)
    placed, surer = agreed(curve, mesh, iou), agreed(curve, mesh, (1 + iou) / 2)
    bounds = sorted([curve.length_mm, arc_length(mesh)])
    assert bounds[0] - 1e-6 <= placed.length_mm <= bounds[1] + 1e-6
    gaps = [abs(one.length_mm - arc_length(mesh)) for one in (placed, surer)]
    assert gaps[1] <= gaps[0] + 1e-6
    assert surer.length_std_mm > 0


@given(st.tuples(*[st.floats(-400, 400)] * 3), st.floats(10, 90), st.floats(5, 100))
def test_rays_to_a_point_meet_and_others_pass(place, degrees, aside_mm):
    second = second_camera(FIRST, degrees=degrees)
    R, t = second_from_first(FIRST, second)
    point = np.add(place, [0, 0, 5000])
    center_mm = -R.T @ t
    ray, other = point, point - center_mm
    assert rays_apart(ray[None], other[None], center_mm)[0] < 1e-6
    normal = np.cross(ray, other) / np.linalg.norm(np.cross(ray, other))
    moved = other + aside_mm * normal
    apart = rays_apart(ray[None], moved[None], center_mm)[0]
    assert apart == pytest.approx(aside_mm, rel=0.2)


def test_both_cameras_agree_on_the_plane():
    second = second_camera(FIRST, degrees=40.0)
    R, t = second_from_first(FIRST, second)
    on_plane = np.array([[0.0, 0, 0], [300, 0, 0], [0, 200, 0]])
    mine = on_plane @ FIRST.plane.rotation.T + FIRST.plane.translation_mm
    other = on_plane @ second.plane.rotation.T + second.plane.translation_mm
    np.testing.assert_allclose(mine @ R.T + t, other, atol=1e-9)
