"""ChArUco boards, half of them out of the picture: known corners, lenses and wrong sizes."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.calibration.corners import CharucoFinder, PrintedBoard, read_grey
from stream_dmr.calibration.known_length import scale_of_board
from stream_dmr.camera import Calibration
from stream_dmr.errors import CalibrationError
from tests.support.board_views import LENS, BoardRenderer, CharucoRenderer, pose, varied_poses
from tests.support.command import invoke

SQUARES, SQUARE_MM, MARKER_MM = (8, 6), 30.0, 22.0
INNER = (SQUARES[0] - 1, SQUARES[1] - 1)
BOARD = PrintedBoard(inner=INNER, square_mm=SQUARE_MM, marker_mm=MARKER_MM)
WHOLE = pose(tilt_deg=(12, -8, 4), distance_mm=480, board=INNER, square_mm=SQUARE_MM)
HALF = pose(
    tilt_deg=(-15, 20, 10), distance_mm=400, shift_mm=(170, 60), board=INNER, square_mm=SQUARE_MM
)


def renderer(dictionary: int = cv2.aruco.DICT_5X5_100, *, is_legacy: bool = False):
    known = cv2.aruco.getPredefinedDictionary(dictionary)
    printed = cv2.aruco.CharucoBoard(SQUARES, SQUARE_MM, MARKER_MM, known)
    printed.setLegacyPattern(is_legacy)
    return CharucoRenderer(LENS, printed, square_mm=SQUARE_MM)


@pytest.fixture(scope="module")
def rendered() -> CharucoRenderer:
    return renderer()


@pytest.mark.parametrize(
    ("dictionary", "is_legacy"),
    [
        (cv2.aruco.DICT_4X4_50, False),
        pytest.param(cv2.aruco.DICT_6X6_250, True, marks=pytest.mark.slow),
        pytest.param(cv2.aruco.DICT_APRILTAG_36h11, False, marks=pytest.mark.slow),
    ],
)
def test_all_corners_are_found_whatever_the_markers(dictionary, is_legacy):
    rendered = renderer(dictionary, is_legacy=is_legacy)
    found = CharucoFinder(INNER, marker_share=MARKER_MM / SQUARE_MM).find(rendered.render(WHOLE))
    assert found is not None
    pixels, numbers = found
    assert sorted(numbers) == list(range(INNER[0] * INNER[1]))
    true = rendered.corners_px(WHOLE)[numbers]
    assert np.sqrt(np.mean(np.sum((pixels - true) ** 2, axis=1))) < 0.25


def test_the_part_in_view_is_enough(rendered):
    seen = BOARD.find(rendered.render(HALF))
    assert seen is not None
    assert 6 <= len(seen.pixels) < 0.7 * INNER[0] * INNER[1]
    numbers = np.rint(seen.points_mm[:, :2] / SQUARE_MM).astype(int) @ [1, INNER[0]]
    true = rendered.corners_px(HALF)[numbers]
    assert np.linalg.norm(seen.pixels - true, axis=1).max() < 0.5


def test_a_wrong_size_is_answered_with_the_one_seen(rendered):
    picture = rendered.render(WHOLE)
    wrong = PrintedBoard(inner=(6, 4), square_mm=SQUARE_MM, marker_mm=MARKER_MM)
    assert wrong.find(picture) is None
    assert wrong.not_found(picture) == (
        "no board of charuco:7x5 (squares) found; saw one of 8x6: check --board"
    )
    empty = np.full((48, 64), 128, np.uint8)
    assert BOARD.find(empty) is None
    assert BOARD.not_found(empty) == "no board of charuco:8x6 (squares) found"


def test_a_chessboard_without_markers_is_no_charuco():
    plain = BoardRenderer(LENS, board=INNER, square_mm=SQUARE_MM).render(WHOLE)
    assert BOARD.find(plain) is None


@pytest.fixture(scope="module")
def folder(rendered, tmp_path_factory) -> Path:
    """plane.png, whole, and boards of which many reach out of the picture."""
    folder = tmp_path_factory.mktemp("charuco")
    assert cv2.imwrite(str(folder / "plane.png"), rendered.render(WHOLE))
    for index, near in enumerate(varied_poses(6, distance_mm=250.0)):
        assert cv2.imwrite(str(folder / f"{index}.png"), rendered.render(near))
    return folder


def test_the_lens_and_the_plane_are_recovered(folder, tmp_path):
    out = tmp_path / "c.yaml"
    options = {"--board": "charuco:8x6", "--square-mm": "30", "--marker-mm": "22"}
    options |= {"--plane": str(folder / "plane.png"), "--out": str(out)}
    pictures = sorted(folder.glob("[0-9]*.png"))
    seen = (BOARD.find(read_grey(path)) for path in pictures)
    assert any(found and len(found.pixels) < 0.7 * INNER[0] * INNER[1] for found in seen)
    done = invoke("calibrate", options | {str(path): None for path in pictures})
    assert done.code == 0, done.error
    made = load_calibration(out)
    np.testing.assert_allclose(np.diag(made.camera.K)[:2], np.diag(LENS.K)[:2], rtol=3e-3)
    distance = made.plane.rotation[:, 2] @ made.plane.translation_mm
    assert distance == pytest.approx(WHOLE.rotation[:, 2] @ WHOLE.translation_mm, rel=3e-3)
    drawn = sorted((tmp_path / "c-corners").iterdir())
    assert len(drawn) == 7


def test_the_scale_is_checked_with_half_a_board(rendered):
    found = scale_of_board([rendered.render(HALF)], Calibration(camera=LENS, plane=HALF), BOARD)
    assert abs(found.error_percent) < 0.2


@pytest.mark.parametrize(
    ("board", "marker_mm", "named"),
    [
        ("charuco:7x5", None, "--marker-mm with --board charuco"),
        ("7x5", 22.0, "only there"),
        ("charuco:7", 22.0, "--board: expected"),
        ("charuco:7x5", 30.0, "below the square's"),
        ("charuco:7x5", -1.0, "above 0"),
    ],
)
def test_boards_that_cannot_be_are_refused(board, marker_mm, named):
    with pytest.raises(CalibrationError, match=named):
        PrintedBoard.parse(board, square_mm=30.0, marker_mm=marker_mm)


def test_a_board_is_named_as_it_is_asked_for():
    for name, marker_mm in (("9x6", None), ("charuco:7x5", 22.0)):
        assert PrintedBoard.parse(name, square_mm=30.0, marker_mm=marker_mm).name == name
