"""Calibration from rendered views of a board whose camera and poses are known."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import pdist
from typer.testing import CliRunner

from stream_dmr.calibration.board import calibrate, draw_views
from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.calibration.corners import (
    BoardCorners,
    PrintedBoard,
    find_corners,
    parse_board,
    read_grey,
)
from stream_dmr.calibration.lens import fit_lens, require_determined
from stream_dmr.errors import CalibrationError, OutputError
from tests.support.board_views import (
    LENS,
    BoardRenderer,
    BoardView,
    board_points,
    pose,
    varied_poses,
)

SIZE = (LENS.width, LENS.height)
PLANE = pose(tilt_deg=(12, -8, 4), distance_mm=480, shift_mm=(10, 5))


@pytest.fixture(scope="module")
def renderer():
    return BoardRenderer(LENS)


@pytest.fixture(scope="module")
def folder(renderer, tmp_path_factory):
    """plane.png and ten tilted views, 0.png to 9.png."""
    folder = tmp_path_factory.mktemp("board")
    save(folder / "plane.png", renderer.render(PLANE))
    for index, view_pose in enumerate(varied_poses(10)):
        save(folder / f"{index}.png", renderer.render(view_pose, BoardView(seed=index)))
    return folder


@pytest.fixture(scope="module")
def views(folder):
    return [folder / f"{index}.png" for index in range(10)]


@pytest.fixture(scope="module")
def result(folder, views):
    return calibrate(views, plane_image=folder / "plane.png")


def save(path, picture):
    assert cv2.imwrite(str(path), picture)
    return path


def corner_error(found, true):
    return np.sqrt(np.mean(np.sum((found - true) ** 2, axis=1)))


def same_lens(one, other):
    """Compare up to the order in which OpenCV's threads add."""
    np.testing.assert_allclose(one.calibration.camera.K, other.calibration.camera.K, rtol=1e-6)


def plane_distance(plane):
    return plane.rotation[:, 2] @ plane.translation_mm


def test_camera_is_recovered(result):
    camera = result.calibration.camera
    np.testing.assert_allclose(np.diag(camera.K)[:2], np.diag(LENS.K)[:2], rtol=2e-3)
    np.testing.assert_allclose(camera.K[:2, 2], LENS.K[:2, 2], atol=2.0)
    assert (camera.width, camera.height) == (LENS.width, LENS.height)
    points = np.stack(np.meshgrid(np.linspace(80, 560, 7), np.linspace(60, 420, 5)), -1)
    rays = LENS.back_project(points.reshape(-1, 2))
    seen = camera.back_project(points.reshape(-1, 2))
    np.testing.assert_allclose(seen, rays, atol=2e-3)


def test_focal_length_lies_within_what_is_claimed(result):
    focal_error = np.diag(result.calibration.camera.K)[:2] - np.diag(LENS.K)[:2]
    assert np.all(np.abs(focal_error) < 4 * result.fit.focal_std_px)
    assert np.all(result.fit.focal_std_px < 1.0)


def test_plane_is_recovered(result):
    plane = result.calibration.plane
    assert plane_distance(plane) == pytest.approx(plane_distance(PLANE), rel=1e-3)
    assert np.degrees(np.arccos(plane.rotation[:, 2] @ PLANE.rotation[:, 2])) < 0.1
    np.testing.assert_allclose(plane.translation_mm, PLANE.translation_mm, atol=1.0)


def test_true_distances_on_the_plane_are_recovered(renderer, result):
    rays = result.calibration.camera.back_project(renderer.corners_px(PLANE))
    points = rays * result.calibration.plane.depth_mm(rays)[:, None]
    np.testing.assert_allclose(pdist(points), pdist(board_points()), rtol=2e-3)


def test_report_agrees_with_what_it_is_about(renderer, result):
    assert len(result.fit.views) == 11
    assert not result.left_out
    assert result.plane_view.path.name == "plane.png"
    true = renderer.corners_px(PLANE)
    assert corner_error(result.plane_view.corners.pixels, true) < 0.1
    for view in result.fit.views:
        assert 0.005 < view.rms_px < 0.15
        assert view.distances.mean_mm <= view.distances.max_mm < 0.5
        assert view.distances.mean_percent < 0.2
    assert result.fit.rms_px == pytest.approx(
        np.sqrt(np.mean([view.rms_px**2 for view in result.fit.views]))
    )


def exact_corners(renderer, poses, *, noise_px=0.0, seed=0):
    rng = np.random.default_rng(seed)
    return {
        Path(f"{index}.png"): BoardCorners(
            pixels=found + rng.normal(0, noise_px, found.shape), points_mm=board_points()
        )
        for index, found in enumerate(map(renderer.corners_px, poses))
    }


def test_exact_corners_give_the_exact_camera(renderer):
    fit = fit_lens(exact_corners(renderer, varied_poses(6)), SIZE)
    np.testing.assert_allclose(fit.camera.K, LENS.K, rtol=1e-4)
    np.testing.assert_allclose(fit.camera.distortion, LENS.distortion, atol=1e-3)
    assert fit.rms_px < 1e-3
    assert max(view.distances.max_mm for view in fit.views) < 1e-2


def test_errors_and_deviations_are_those_of_the_noise(renderer):
    """The reprojection error is the noise that was added, and the focal error what is claimed."""
    scores = []
    for seed in range(12):
        poses = varied_poses(8, seed=seed)
        corners = exact_corners(renderer, poses, noise_px=0.3, seed=seed)
        fit = fit_lens(corners, SIZE)
        assert fit.rms_px == pytest.approx(0.3 * np.sqrt(2), rel=0.1)
        scores.append((np.diag(fit.camera.K)[:2] - np.diag(LENS.K)[:2]) / fit.focal_std_px)
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6


def test_unusable_pictures_are_left_out_by_name(folder, views, renderer, tmp_path, result):
    """And those given twice, as the plane's, count once."""
    rng = np.random.default_rng(0)
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff")
    (tmp_path / "empty.jpg").write_bytes(b"")
    save(tmp_path / "sea.png", rng.integers(0, 255, (480, 640)).astype(np.uint8))
    save(tmp_path / "small.png", np.zeros((240, 320), np.uint8))
    save(tmp_path / "half.png", renderer.render(pose(shift_mm=(150, 0))))
    save(tmp_path / "again.png", renderer.render(PLANE, BoardView(seed=5)))
    named = {
        "broken.jpg": "no picture",
        "empty.jpg": "no picture",
        "none.jpg": "can't be read",
        "sea.png": "no board",
        "half.png": "no board",
        "small.png": "320x240 px, another size",
        "again.png": "almost the same view as plane.png",
    }
    pictures = [tmp_path / name for name in named]
    twice = [folder / "plane.png", views[0]]
    mixed = calibrate([*pictures, *views, *twice], plane_image=folder / "plane.png")
    assert len(mixed.fit.views) == 11
    assert [left.path for left in mixed.left_out] == pictures
    for left, reason in zip(mixed.left_out, named.values(), strict=True):
        assert left.reason.startswith(reason)
    same_lens(mixed, result)


def test_a_view_that_fits_badly_is_left_out(folder, views, renderer, tmp_path, result):
    picture = renderer.render(pose(tilt_deg=(-20, 25, 10), shift_mm=(20, 10)))
    rows, columns = np.mgrid[:480, :640].astype(np.float32)
    torn = cv2.remap(picture, columns + 6 * np.sin(rows / 50), rows, 1)  # a rolling shutter
    bad = save(tmp_path / "torn.png", torn)
    mixed = calibrate([bad, *views], plane_image=folder / "plane.png", model="pinhole")
    assert [left.path for left in mixed.left_out] == [bad]
    assert "px off" in mixed.left_out[0].reason
    same_lens(mixed, result)


def test_too_few_views_are_refused(folder, views):
    with pytest.raises(CalibrationError, match=r"at least 5 .* got 4 \(none.png: can't be read"):
        calibrate([*views[:3], folder / "none.png"], plane_image=folder / "plane.png")


def test_five_views_do_but_warn(folder, views):
    few = calibrate(views[:8:2], plane_image=folder / "plane.png")
    np.testing.assert_allclose(
        np.diag(few.calibration.camera.K)[:2], np.diag(LENS.K)[:2], rtol=5e-3
    )
    assert any("only 5 views" in warning for warning in few.warnings)


@pytest.mark.parametrize("tilt", [(0, 0), (25, 0), (-10, 30)])
@pytest.mark.parametrize(
    "noise_px",
    [pytest.param(0.0, marks=pytest.mark.slow), 0.05, pytest.param(0.5, marks=pytest.mark.slow)],
)
def test_boards_all_held_alike_are_refused(renderer, tilt, noise_px):
    rng = np.random.default_rng(1)
    poses = [
        pose(
            tilt_deg=(*tilt, 0),
            distance_mm=rng.uniform(420, 700),
            shift_mm=tuple(rng.uniform(-40, 40, 2)),
        )
        for _ in range(8)
    ]
    with pytest.raises(CalibrationError, match="tilted to different sides"):
        require_determined(fit_lens(exact_corners(renderer, poses, noise_px=noise_px), SIZE))


def test_a_few_noisy_and_hardly_tilted_boards_are_refused(renderer):
    poses = [pose(tilt_deg=(tilt, 0, 0)) for tilt in (-6, -3, 0, 3, 6)]
    corners = exact_corners(renderer, poses, noise_px=0.5)
    with pytest.raises(CalibrationError, match="standard deviation"):
        require_determined(fit_lens(corners, SIZE))


def test_the_planes_picture_must_be_usable(folder, views, tmp_path):
    blank = save(tmp_path / "blank.png", np.full((480, 640), 128, np.uint8))
    with pytest.raises(CalibrationError, match=r"--plane .*blank.png.*no board of 9x6"):
        calibrate(views, plane_image=blank)
    with pytest.raises(CalibrationError, match=r"--plane .*none.png.*can't be read"):
        calibrate(views, plane_image=tmp_path / "none.png")
    with pytest.raises(CalibrationError, match=r"no board of 8x5 .*saw one of 9x6: check --board"):
        calibrate(views, plane_image=folder / "plane.png", board=PrintedBoard(inner=(8, 5)))


@pytest.mark.parametrize("square_mm", [0.0, -25.0, 0.025, 1e6, float("nan")])
def test_impossible_squares_are_refused(square_mm):
    with pytest.raises(CalibrationError, match="--square-mm"):
        PrintedBoard(square_mm=square_mm)


@pytest.mark.parametrize("text", ["9x6", "9X6", " 9 x 6 "])
def test_board_is_read(text):
    assert parse_board(text) == (9, 6)


@pytest.mark.parametrize("text", ["", "9", "9x", "9x6x2", "9x2", "nine", "-9x6", "9,6", "9x6000"])
def test_other_boards_are_refused(text):
    with pytest.raises(CalibrationError, match="--board: expected"):
        parse_board(text)


@pytest.mark.parametrize(
    ("view", "limit_px"),
    [
        (BoardView(shade=0.9, noise=3.0), 0.2),
        (BoardView(noise=8.0), 0.15),
        (BoardView(blur_px=3.0), 0.15),
    ],
)
def test_corners_in_bad_light_noise_and_blur(renderer, view, limit_px):
    found = find_corners(renderer.render(PLANE, view), (9, 6))
    assert found is not None
    assert corner_error(found, renderer.corners_px(PLANE)) < limit_px


def test_corners_of_a_big_picture_are_as_sharp_as_it_is(renderer):
    """A small copy is searched; the corners must come from the big one, half pixels right."""
    picture = BoardRenderer(LENS, samples=3).render(PLANE)
    big = cv2.resize(picture, None, fx=5, fy=5, interpolation=cv2.INTER_CUBIC)
    found = find_corners(big, (9, 6))
    assert found is not None
    true = (renderer.corners_px(PLANE) + 0.5) * 5 - 0.5
    assert corner_error(found, true) < 0.4


@pytest.mark.parametrize("turn", [None, cv2.ROTATE_180])
def test_corners_begin_at_the_top_left_whichever_way_the_board_is_held(renderer, turn):
    picture = renderer.render(PLANE)
    true = renderer.corners_px(PLANE)
    if turn is not None:
        picture = np.ascontiguousarray(cv2.rotate(picture, turn))
        true = ([639.0, 479.0] - true)[::-1]
    found = find_corners(picture, (9, 6))
    assert found is not None
    assert corner_error(found, true) < 0.1


def test_sixteen_bit_colour_pictures_are_read(tmp_path):
    deep = np.random.default_rng(0).integers(0, 65535, (20, 30, 3)).astype(np.uint16)
    assert read_grey(save(tmp_path / "deep.png", deep)).shape == (20, 30)


def test_a_picture_that_is_cut_off_is_refused(tmp_path):
    path = save(tmp_path / "half.jpg", np.random.default_rng(0).integers(0, 255, (20, 30)))
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(CalibrationError, match="a broken one"):
        read_grey(path)


def test_pictures_are_not_turned_by_exif(tmp_path):
    """The lens does not turn with the way up that a picture is shown."""
    _, encoded = cv2.imencode(".jpg", np.zeros((20, 30), np.uint8))
    tiff = b"MM\0*\0\0\0\x08" + b"\0\x01" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0" + bytes(4)
    exif = b"Exif\0\0" + tiff
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    content = encoded.tobytes()
    (tmp_path / "turned.jpg").write_bytes(content[:2] + segment + content[2:])
    assert cv2.imread(str(tmp_path / "turned.jpg")).shape[:2] == (30, 20)
    assert read_grey(tmp_path / "turned.jpg").shape == (20, 30)


def test_drawing_refuses_an_unwritable_folder(result, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        draw_views(result, tmp_path / "file")


def test_the_command_writes_the_file_and_the_drawings(folder, views, result, tmp_path):
    import typer

    from stream_dmr.cli.calibrate import calibrate as command
    from stream_dmr.cli.shared_options import typer_command

    app = typer.Typer()
    app.command()(typer_command(command))
    out = tmp_path / "calibration.yaml"
    arguments = ["--plane", folder / "plane.png", *views, folder / "none.png", "--out", out]
    outcome = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert outcome.exit_code == 0, outcome.output
    assert "plane.png (plane)" in outcome.output
    assert "none.png: can't be read" in outcome.output
    written = load_calibration(out)
    np.testing.assert_allclose(written.camera.K, result.calibration.camera.K, rtol=1e-6)
    drawn = sorted((tmp_path / "calibration-corners").iterdir())
    assert len(drawn) == 11
    assert drawn[0].name == "01_plane.png"
    picture = cv2.imread(str(drawn[0]))
    assert np.any(picture.max(axis=2) > picture.min(axis=2))  # colours: something was drawn
