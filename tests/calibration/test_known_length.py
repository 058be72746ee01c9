"""A known length in the reference plane shows a wrong scale, and nothing where it is right."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.calibration.corners import PrintedBoard, seen_board
from stream_dmr.calibration.known_length import scale_of_board, scale_of_points
from stream_dmr.camera import Calibration, ReferencePlane
from stream_dmr.errors import CalibrationError
from stream_dmr.files import sha256_of
from stream_dmr.store.fish import run_notes
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.scale_checks import last_checks
from tests.support.board_views import LENS, BoardRenderer, pose
from tests.support.command import invoke, rows
from tests.support.final_estimates import FACTS
from tests.support.fish_run import measure

PLANE = pose(tilt_deg=(12, -8, 4), distance_mm=480, shift_mm=(10, 5))
TRUE = Calibration(camera=LENS, plane=PLANE)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    return BoardRenderer(LENS).render(PLANE)


def farther(share: float) -> Calibration:
    """The plane is taken for farther away than it is."""
    plane = ReferencePlane(
        rotation=PLANE.rotation, translation_mm=PLANE.translation_mm * (1 + share)
    )
    return replace(TRUE, plane=plane)


@pytest.mark.parametrize(
    "share",
    [pytest.param(0.0, marks=pytest.mark.slow), 0.05, pytest.param(-0.02, marks=pytest.mark.slow)],
)
def test_the_error_is_that_of_the_scale(picture: np.ndarray, share: float):
    found = scale_of_board([picture], farther(share), PrintedBoard())
    assert found.error_percent == pytest.approx(100 * share, abs=0.1)
    assert found.known_mm == pytest.approx(25 * np.hypot(8, 5))
    assert found.error_mm == pytest.approx(share * found.known_mm, abs=0.3)


def test_a_rod_is_measured_by_its_ends():
    ends = np.array([[0.0, 0, 0], [200.0, 0, 0]]) @ PLANE.rotation.T + PLANE.translation_mm
    found = scale_of_points(
        LENS.project(ends), np.array([[0.0, 0, 0], [200.0, 0, 0]]), farther(0.1)
    )
    assert found.error_mm == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("ends", "length_mm", "expected"),
    [
        ("120,300,9800,310", "200", r"two points of the picture, 640x480 px, got .*\(9800, 310\)"),
        ("120,300,nan,310", "200", "two points of the picture"),
        ("-1,300,98,310", "200", "two points of the picture"),
        ("120,300,120,300", "200", r"the same point twice, \(120, 300\)"),
        ("120,300,220,300", "0", "--length-mm: expected the rod's length, got 0"),
    ],
)
def test_a_rod_that_can_not_be_in_the_picture_is_no_alarm(
    files: dict[str, Path], ends: str, length_mm: str, expected: str
):
    options = {"--calibration": str(files["right"]), "--ends": ends, "--length-mm": length_mm}
    outcome = invoke(f"check {files['picture']}", options)
    assert outcome.code == 2
    assert re.search(expected, outcome.error)


def test_a_board_of_another_size_is_named(picture: np.ndarray):
    assert seen_board(picture) == (9, 6)
    assert seen_board(np.full((480, 640), 128, np.uint8)) is None
    with pytest.raises(CalibrationError, match=r"no board of 8x5 .*saw one of 9x6"):
        scale_of_board([picture], TRUE, PrintedBoard(inner=(8, 5)))


@pytest.fixture
def files(tmp_path: Path, picture: np.ndarray) -> dict[str, Path]:
    made = {name: tmp_path / f"{name}.yaml" for name in ("right", "wrong")}
    save_calibration(made["right"], TRUE)
    save_calibration(made["wrong"], farther(0.05))
    cv2.imwrite(str(tmp_path / "board.png"), picture)
    return made | {"picture": tmp_path / "board.png"}


def test_the_command_keeps_it_and_raises_an_alarm(files: dict[str, Path], tmp_path: Path):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("right", "wrong"):
        facts = replace(FACTS, calibration_sha256=sha256_of(files[name]))
        LengthStore(out, facts).close()
        options = {"--calibration": str(files[name]), "--out": str(out)}
        outcome = invoke(f"check {files['picture']}", options)
        assert outcome.code == (name == "wrong")
        assert ("alarm" in outcome.out) is (name == "wrong")
    checks = last_checks(out / "lengths.db")
    assert len(checks) == 2
    assert [line for line in run_notes(out) if "too long" in line]


def test_exports_have_the_last_check(files: dict[str, Path], tmp_path: Path):
    out = measure(tmp_path)
    calibration = tmp_path / "clip" / "calibration.yaml"
    options = {"--calibration": str(calibration), "--out": str(out), "--limit": "1e9"}
    options |= {"--ends": "20,60,140,60", "--length-mm": "100"}
    video = tmp_path / "clip" / "video.mp4"
    assert invoke(f"check {video}", options).code == 0
    invoke("export", {str(out): None, "--fish": "csv", "--out": str(tmp_path / "exp")})
    (check,) = last_checks(out / "lengths.db").values()
    for row in rows(tmp_path / "exp" / "fish.csv"):
        assert float(row["scale_error_percent"]) == pytest.approx(check.error_percent, abs=1e-5)
        assert int(row["scale_checked_ns"]) == check.time_ns


def test_a_rod_needs_both_and_a_run_its_database(files: dict[str, Path], tmp_path: Path):
    options = {"--calibration": str(files["right"])}
    outcome = invoke(f"check {files['picture']}", options | {"--length-mm": "5"})
    assert (outcome.code, "belong together" in outcome.error) == (2, True)
    ends = {"--ends": "1,2,3", "--length-mm": "5"}
    outcome = invoke(f"check {files['picture']}", options | ends)
    assert (outcome.code, "U,V,U,V" in outcome.error) == (2, True)
    outcome = invoke(f"check {files['picture']}", options | {"--out": str(tmp_path)})
    assert "found no lengths.db" in outcome.error
