"""The fisheye model against its equation, and domes of which the truth is known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stream_dmr.calibration.board import calibrate
from stream_dmr.calibration.calibration_file import load_calibration, save_calibration
from stream_dmr.calibration.corners import BoardCorners
from stream_dmr.calibration.known_length import scale_of_points
from stream_dmr.calibration.lens import choose_fit, find_plane, fit_lens
from stream_dmr.camera import (
    MAX_FISHEYE_ANGLE_RAD,
    Calibration,
    Camera,
    ReferencePlane,
    crop_from_frame,
    frame_from_crop,
)
from stream_dmr.recording.codec import decode, encode
from stream_dmr.segmentation.crop_geometry import frame_from_crop_map
from tests.support.board_views import LENS, BoardRenderer, board_points
from tests.support.command import invoke

WIDTH, HEIGHT = 960, 720
unit = st.floats(-1, 1)


def dome(*, width_deg: float = 150.0, coefficients=(0.03, -0.012, 0.004, -0.001)) -> Camera:
    """A lens that sees `width_deg` over the picture's width, but for its distortion."""
    focal = WIDTH / np.radians(width_deg)
    K = np.array([[focal, 0, 489.3], [0, 1.004 * focal, 351.8], [0, 0, 1]])
    distortion = np.array(coefficients, np.float64)
    return Camera(width=WIDTH, height=HEIGHT, K=K, distortion=distortion, is_fisheye=True)


DOME = dome()


@st.composite
def domes(draw) -> Camera:
    bounds = np.array([0.05, 0.02, 0.005, 0.001])
    coefficients = bounds * [draw(unit) for _ in range(4)]
    return dome(width_deg=draw(st.floats(60, 200)), coefficients=coefficients)


def directions(*, up_to_deg: float, num: int = 60, seed: int = 0) -> np.ndarray:
    """Points (N, 3) at depth 1, at angles up to that from the axis."""
    rng = np.random.default_rng(seed)
    angles, around = np.radians(rng.uniform(0, up_to_deg, num)), rng.uniform(0, 2 * np.pi, num)
    radius = np.tan(angles)
    return np.column_stack([radius * np.cos(around), radius * np.sin(around), np.ones(num)])


def slow_projection(camera: Camera, point: np.ndarray) -> np.ndarray:
    """Kannala and Brandt's lens as OpenCV writes it, for one point."""
    angle = np.arctan2(np.hypot(point[0], point[1]), point[2])
    k1, k2, k3, k4 = camera.distortion
    radius = angle + k1 * angle**3 + k2 * angle**5 + k3 * angle**7 + k4 * angle**9
    around = np.arctan2(point[1], point[0])
    plain = [radius * np.cos(around), radius * np.sin(around), 1.0]
    return (camera.K @ plain)[:2]


@given(domes(), st.floats(1, 1e4))
def test_projection_follows_the_lens_equation(camera, depth):
    points = depth * directions(up_to_deg=84)
    expected = [slow_projection(camera, point) for point in points]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-7)


def least_slope(camera: Camera, *, up_to_deg: float) -> float:
    """Of the radius over the angle: where a lens all but folds over, there is no way back."""
    k1, k2, k3, k4 = camera.distortion
    a = np.radians(np.linspace(0, up_to_deg, 200)) ** 2
    return float((1 + 3 * k1 * a + 5 * k2 * a**2 + 7 * k3 * a**3 + 9 * k4 * a**4).min())


@given(domes())
def test_a_ray_undoes_the_projection(camera):
    assume(least_slope(camera, up_to_deg=84.5) > 0.05)  # as the camera asks
    points = directions(up_to_deg=84)
    rays = camera.back_project(camera.project(points))
    np.testing.assert_allclose(rays, points, rtol=1e-9, atol=1e-9)


def test_a_lens_with_radii_beyond_a_right_angle_is_undone_as_well():
    """cv2.fisheye.undistortPoints clips those: a stereographic lens has 1.8 at 85 degrees."""
    camera = dome(width_deg=100, coefficients=(0.09, 0.01, 0.0, 0.0))
    points = directions(up_to_deg=84)
    assert camera.project(points).max() > WIDTH  # so it is one
    np.testing.assert_allclose(camera.back_project(camera.project(points)), points, rtol=1e-9)


@pytest.mark.parametrize("coefficients", [(0.0, 0.0, 0.0, 0.0), (-0.2, 0.0, 0.0, 0.0)])
def test_pixels_beyond_what_the_model_sees_get_its_widest_ray(coefficients):
    """The picture of a 220 degree dome, and one whose model folds over: finite, and no way back."""
    camera = dome(width_deg=220, coefficients=coefficients)
    rays = camera.back_project(np.array([[-40.0, 351.8], [WIDTH + 90.0, HEIGHT + 90.0]]))
    angles = np.arctan(np.hypot(rays[:, 0], rays[:, 1]))
    assert np.isfinite(rays).all()
    assert angles[0] == pytest.approx(angles[1])
    assert angles.max() <= MAX_FISHEYE_ANGLE_RAD + 1e-12


def test_the_middle_has_the_axis():
    np.testing.assert_array_equal(DOME.back_project(DOME.K[:2, 2][None]), [[0.0, 0.0, 1.0]])


@given(domes(), st.floats(0.3, 0.7), st.floats(0.3, 0.7), st.floats(30, 200))
def test_crop_and_frame_undo_each_other(camera, u, v, side):
    crop = camera.crop(center_px=np.array([u * WIDTH, v * HEIGHT]), side_px=side, size=64)
    assert not crop.is_fisheye
    pixels = np.random.default_rng(1).uniform(0, 63, (30, 2))
    frame = frame_from_crop(pixels, crop_camera=crop, frame_camera=camera)
    back = crop_from_frame(frame, crop_camera=crop, frame_camera=camera)
    np.testing.assert_allclose(back, pixels, atol=1e-5)
    x, y = frame_from_crop_map(crop, frame_camera=camera)
    seen = np.rint(pixels).astype(int)
    expected = frame_from_crop(seen.astype(float), crop_camera=crop, frame_camera=camera)
    mapped = np.column_stack([x[seen[:, 1], seen[:, 0]], y[seen[:, 1], seen[:, 0]]])
    np.testing.assert_allclose(mapped, expected, atol=1e-3)


def poses(num: int, *, seed: int = 0) -> list[ReferencePlane]:
    """Boards turned to all sides, up to 55 degrees off the axis, all of them in the picture."""
    rng, found = np.random.default_rng(seed), []
    middle = board_points().mean(axis=0)
    while len(found) < num:
        off, around = np.radians(rng.uniform(0, 55)), rng.uniform(0, 2 * np.pi)
        towards = Rotation.from_rotvec(off * np.array([np.cos(around), np.sin(around), 0]))
        turned = towards * Rotation.from_euler("xyz", rng.uniform(-30, 30, 3), degrees=True)
        place = towards.apply([0, 0, rng.uniform(170, 330)])
        rotation = turned.as_matrix()
        pose = ReferencePlane(rotation=rotation, translation_mm=place - rotation @ middle)
        points = board_points() @ rotation.T + pose.translation_mm
        seen = DOME.project(points)
        if points[:, 2].min() > 20 and np.all((seen > 8) & (seen < [WIDTH - 8, HEIGHT - 8])):
            found.append(pose)
    return found


def corners_of(camera: Camera, pose: ReferencePlane, noise: np.ndarray | float) -> BoardCorners:
    seen = camera.project(board_points() @ pose.rotation.T + pose.translation_mm)
    return BoardCorners(pixels=seen + noise, points_mm=board_points())


def test_the_plane_is_found_through_a_dome_as_through_a_pinhole():
    """Also where the board lies far out, and two poses look nearly alike."""
    for camera in (DOME, replace(LENS, width=WIDTH, height=HEIGHT)):
        for pose in poses(10, seed=7):
            plane, rms_px = find_plane(corners_of(camera, pose, 0.0), camera)
            assert rms_px < 1e-6
            np.testing.assert_allclose(plane.rotation, pose.rotation, atol=1e-7)
            np.testing.assert_allclose(plane.translation_mm, pose.translation_mm, atol=1e-5)


def views(*, noise_px: float = 0.0, num: int = 10, seed: int = 0) -> dict[Path, BoardCorners]:
    rng = np.random.default_rng(seed)
    return {
        Path(f"{k}.png"): corners_of(DOME, pose, rng.normal(0, noise_px, (54, 2)))
        for k, pose in enumerate(poses(num, seed=seed))
    }


def test_exact_corners_give_the_exact_lens():
    fit = fit_lens(views(), (WIDTH, HEIGHT), is_fisheye=True)
    np.testing.assert_allclose(fit.camera.K, DOME.K, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(fit.camera.distortion, DOME.distortion, atol=1e-5)
    assert fit.rms_px < 1e-4
    assert max(view.distances.max_mm for view in fit.views) < 1e-3


def test_errors_and_deviations_are_those_of_the_noise():
    scores = []
    for seed in range(5):
        fit = fit_lens(views(noise_px=0.2, seed=seed), (WIDTH, HEIGHT), is_fisheye=True)
        assert fit.rms_px == pytest.approx(0.2 * np.sqrt(2), rel=0.1)
        scores.append((np.diag(fit.camera.K)[:2] - np.diag(DOME.K)[:2]) / fit.focal_std_px)
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6


def test_a_dome_is_recognised_and_a_pinhole_stays_one():
    seen, size = views(noise_px=0.1), (WIDTH, HEIGHT)
    chosen = choose_fit(seen, size, plane_image=Path("0.png"), model="auto")
    assert chosen.fit.camera.is_fisheye
    assert "fisheye model is used" in chosen.note
    rng = np.random.default_rng(0)
    narrow = replace(LENS, width=WIDTH, height=HEIGHT, K=1.5 * LENS.K + np.diag([0, 0, -0.5]))
    seen = {
        Path(f"{k}.png"): corners_of(narrow, pose, rng.normal(0, 0.1, (54, 2)))
        for k, pose in enumerate(poses(14))
        if abs(pose.translation_mm[0]) < 150
    }
    chosen = choose_fit(seen, size, plane_image=next(iter(seen)), model="auto")
    assert not chosen.fit.camera.is_fisheye
    assert not chosen.note


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """plane.png, 0.png to 10.png: a board through the dome."""
    folder, renderer = tmp_path_factory.mktemp("dome"), BoardRenderer(DOME, samples=2)
    for name, pose in zip(["plane", *range(11)], poses(12, seed=3), strict=True):
        assert cv2.imwrite(str(folder / f"{name}.png"), renderer.render(pose))
    return folder


@pytest.mark.slow
def test_rendered_boards_give_the_dome_and_true_lengths(folder, tmp_path):
    """All by the command: the lens is recognised, written, read, and measures."""
    out = tmp_path / "dome.yaml"
    pictures = {str(path): None for path in sorted(folder.glob("[0-9]*.png"))}
    done = invoke("calibrate", {"--plane": str(folder / "plane.png"), "--out": str(out)} | pictures)
    assert done.code == 0, done.error
    assert "fisheye model is used" in done.out
    made = load_calibration(out)
    assert made.camera.is_fisheye
    assert "distortion_model: fisheye" in out.read_text()
    np.testing.assert_allclose(np.diag(made.camera.K)[:2], np.diag(DOME.K)[:2], rtol=3e-3)
    plane = poses(12, seed=3)[0]
    true = DOME.project(board_points() @ plane.rotation.T + plane.translation_mm)
    scale = scale_of_points(true, board_points(), made)
    assert abs(scale.error_percent) < 0.1
    assert scale.worst_percent < 1.0


@pytest.mark.slow
def test_a_pinhole_that_is_asked_for_says_what_else_to_try(folder):
    pictures = sorted(folder.glob("[0-9]*.png"))
    result = calibrate(pictures, plane_image=folder / "plane.png", model="pinhole")
    assert not result.calibration.camera.is_fisheye
    assert any("--model fisheye" in warning for warning in result.warnings)


@given(domes())
def test_the_file_and_the_recording_give_the_lens_back(tmp_path_factory, camera):
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, 900.0]))
    path = tmp_path_factory.mktemp("dome") / "dome.yaml"
    save_calibration(path, Calibration(camera=camera, plane=plane))
    for back in (load_calibration(path).camera, decode(Camera, encode(camera))):
        assert back.is_fisheye
        np.testing.assert_array_equal(back.K, camera.K)
        np.testing.assert_array_equal(back.distortion, camera.distortion)


def test_the_file_of_a_pinhole_is_what_it_was(tmp_path):
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, 900.0]))
    save_calibration(tmp_path / "c.yaml", Calibration(camera=LENS, plane=plane))
    assert "distortion_model" not in (tmp_path / "c.yaml").read_text()
    assert not decode(Camera, encode(LENS)).is_fisheye


@pytest.mark.parametrize(("width_deg", "seed"), [(90, 1), (190, 0), (190, 1), (190, 2)])
def test_lenses_of_any_width_are_found(width_deg, seed):
    lens, rng = dome(width_deg=width_deg), np.random.default_rng(seed)
    seen = {
        Path(f"{k}.png"): corners_of(lens, pose, rng.normal(0, 0.1, (54, 2)))
        for k, pose in enumerate(poses(14, seed=seed))
    }
    fit = fit_lens(seen, (WIDTH, HEIGHT), is_fisheye=True)
    assert fit.rms_px < 0.2
    np.testing.assert_allclose(np.diag(fit.camera.K)[:2], np.diag(lens.K)[:2], rtol=0.02)
