"""One known length in a picture that was taken squarely gives the reference plane."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.calibration.board import calibrate_squarely, camera_of_focal_35mm
from stream_dmr.calibration.calibration_file import load_calibration, save_calibration
from stream_dmr.calibration.known_length import scale_of_ends
from stream_dmr.errors import CalibrationError
from tests.support.board_views import LENS
from tests.support.command import invoke

ENDS = np.array([[40.0, 60.0], [140.0, 60.0]])


@given(st.floats(0, 500), st.floats(0, 400), st.floats(5, 500))
def test_the_known_length_is_measured_as_it_is(u: float, v: float, length_mm: float):
    ends = np.array([[u, v], [630.0, 470.0]])
    calibration = calibrate_squarely(ends, length_mm, LENS)
    assert scale_of_ends(ends, length_mm, calibration).error_mm == pytest.approx(0, abs=1e-6)
    assert calibration.plane.distance_mm == calibration.plane.translation_mm[2] > 0


def test_a_plane_that_no_run_would_take_is_not_written(tmp_path: Path):
    near = calibrate_squarely(np.array([[0.0, 0.0], [630.0, 470.0]]), 1.0, LENS)
    with pytest.raises(CalibrationError, match="closer than 10 mm"):
        save_calibration(tmp_path / "c.yaml", near)
    assert not any(tmp_path.iterdir())


def test_the_focal_length_is_that_of_the_diagonal():
    phone = camera_of_focal_35mm(26.0, width=4000, height=3000)
    assert phone.K[0, 0] == pytest.approx(5000 * 26 / 43.27)
    with pytest.raises(CalibrationError, match="8 to 1000 mm, got 3000"):
        camera_of_focal_35mm(3000.0, width=4000, height=3000)


def test_a_ruler_calibrates_by_the_command(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "fish.png"), np.zeros((300, 400), np.uint8))
    out = str(tmp_path / "c.yaml")
    ruler = {"--plane": str(tmp_path / "fish.png"), "--ends": "40,60,140,60", "--out": out}
    known: dict[str, str | None] = {**ruler, "--length-mm": "50", "--overwrite": None}
    for lens in ({"--focal-35mm": "26"}, {"--lens": out}):
        assert "0.5000 mm a pixel" in invoke("calibrate", known | lens).out
        calibration = load_calibration(out)
        assert scale_of_ends(ENDS, 50.0, calibration).error_mm == pytest.approx(0, abs=1e-6)
    for wrong in (known, known | {"--focal-35mm": "26", "--lens": out}, ruler | {"--lens": out}):
        assert "--ends: expected --length-mm" in invoke("calibrate", wrong).error
