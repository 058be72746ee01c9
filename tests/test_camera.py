"""The camera and the plane against geometry written out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stream_dmr.camera import Camera, ReferencePlane, crop_from_frame, frame_from_crop

unit = st.floats(-1, 1)


@st.composite
def cameras(draw, *, distorted=True):
    """Cameras from narrow to wide, with lenses as mild as real ones inside the picture."""
    width, height = draw(st.sampled_from([(640, 480), (1281, 720), (480, 853)]))
    focal = max(width, height) * draw(st.floats(0.9, 2.0))
    K = np.array(
        [
            [focal, 0.0, width / 2 + 20 * draw(unit)],
            [0.0, focal * (1 + 0.02 * draw(unit)), height / 2 + 20 * draw(unit)],
            [0.0, 0.0, 1.0],
        ]
    )
    bounds = np.array([0.15, 0.05, 0.002, 0.002, 0.01]) * distorted
    distortion = bounds * draw(arrays(np.float64, 5, elements=unit))
    return Camera(width=width, height=height, K=K, distortion=distortion)


@st.composite
def planes(draw):
    """Planes 0.3 to 3 m in front of the camera, up to some 50 degrees from square to it."""
    x, y, z = 0.6 * draw(unit), 0.6 * draw(unit), 3 * draw(unit)
    turns = [
        np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]),
        np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]]),
        np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]),
    ]
    distance = draw(st.floats(300, 3000))
    middle = distance * np.array([0.3 * draw(unit), 0.3 * draw(unit), 1.0])
    return ReferencePlane(rotation=turns[0] @ turns[1] @ turns[2], translation_mm=middle)


def pixels_in(camera: Camera, *, num=40, seed=0) -> np.ndarray:
    sides = [camera.width - 1, camera.height - 1]
    return np.random.default_rng(seed).uniform(0, 1, (num, 2)) * sides


def slow_projection(camera: Camera, point: np.ndarray) -> np.ndarray:
    """Brown's lens as Sec. 2.3 and OpenCV write it, for one point."""
    x, y = point[0] / point[2], point[1] / point[2]
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.array([camera.K[0, 0] * u + camera.K[0, 2], camera.K[1, 1] * v + camera.K[1, 2]])


@given(cameras())
def test_project_follows_the_lens_equations(camera):
    points = camera.back_project(pixels_in(camera)) * 700.0
    expected = [slow_projection(camera, point) for point in points]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


@given(cameras())
def test_project_undoes_back_project(camera):
    pixels = pixels_in(camera)
    np.testing.assert_allclose(camera.project(camera.back_project(pixels)), pixels, atol=1e-6)


@given(cameras(), st.floats(1, 1e4))
def test_back_project_undoes_project_up_to_depth(camera, depth):
    points = camera.back_project(pixels_in(camera)) * depth
    rays = camera.back_project(camera.project(points))
    np.testing.assert_allclose(rays * depth, points, rtol=1e-7, atol=1e-7 * depth)


def test_pixel_centres_are_integers():
    camera = Camera(
        width=5, height=3, K=np.array([[2.0, 0, 2], [0, 2, 1], [0, 0, 1]]), distortion=np.zeros(5)
    )
    np.testing.assert_allclose(camera.back_project(np.array([[2.0, 1.0]])), [[0, 0, 1]])
    np.testing.assert_allclose(camera.project(np.array([[1.0, -0.5, 1.0]])), [[4, 0]])


@given(cameras(), st.floats(0.2, 0.8), st.floats(0.2, 0.8), st.floats(30, 400))
def test_crop_and_frame_maps_undo_each_other(camera, u, v, side):
    crop = camera.crop(
        center_px=np.array([u * camera.width, v * camera.height]), side_px=side, size=128
    )
    pixels = np.random.default_rng(1).uniform(0, 127, (30, 2))
    frame = frame_from_crop(pixels, crop_camera=crop, frame_camera=camera)
    back = crop_from_frame(frame, crop_camera=crop, frame_camera=camera)
    np.testing.assert_allclose(back, pixels, atol=1e-5)


@given(cameras(), st.floats(0.2, 0.8), st.floats(0.2, 0.8), st.floats(30, 400))
def test_crop_keeps_directions(camera, u, v, side):
    center = np.array([u * camera.width, v * camera.height])
    crop = camera.crop(center_px=center, side_px=side, size=96)
    points = camera.back_project(pixels_in(camera)) * 900.0
    through_crop = crop.back_project(crop.project(points))
    np.testing.assert_allclose(through_crop, camera.back_project(camera.project(points)), atol=1e-8)
    np.testing.assert_allclose(crop.project(camera.back_project(center[None])), [[47.5, 47.5]])


@given(cameras(distorted=False), st.floats(30, 400))
def test_crop_without_distortion_spans_its_side(camera, side):
    center = np.array([camera.width / 2, camera.height / 2])
    crop = camera.crop(center_px=center, side_px=side, size=64)
    ends = np.array([[-0.5, 31.5], [63.5, 31.5]])
    frame = frame_from_crop(ends, crop_camera=crop, frame_camera=camera)
    np.testing.assert_allclose(frame[1] - frame[0], [side, 0.0], atol=1e-6)


@given(cameras(distorted=False), planes())
def test_homography_agrees_with_projection(camera, plane):
    on_plane = np.random.default_rng(2).uniform(-0.1, 0.1, (20, 3)) * plane.translation_mm[2]
    on_plane[:, 2] = 0.0
    seen = camera.project(on_plane @ plane.rotation.T + plane.translation_mm)
    mapped = np.column_stack([on_plane[:, :2], np.ones(20)]) @ plane.homography(camera.K).T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], seen, atol=1e-6)


@given(cameras(), planes())
def test_depth_is_where_the_ray_meets_the_plane(camera, plane):
    rays = camera.back_project(pixels_in(camera))
    normal = plane.rotation[:, 2]
    expected = [normal @ plane.translation_mm / (normal @ ray) for ray in rays]
    np.testing.assert_allclose(plane.depth_mm(rays), expected, rtol=1e-9)


def test_depth_is_negative_behind_the_camera():
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, -500.0]))
    assert plane.depth_mm(np.array([[0.1, 0.0, 1.0]]))[0] == pytest.approx(-500.0)


def test_nominal_camera_looks_straight_ahead():
    camera = Camera.nominal(width=640, height=360)
    np.testing.assert_allclose(camera.back_project(np.array([[319.5, 179.5]])), [[0, 0, 1]])
