"""Refuses lens distortions that no lens has, such as coefficients in another order or unit."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.calibration.calibration_values import CALIBRATE
from stream_dmr.camera import Camera
from stream_dmr.errors import CalibrationError

_GRID = 41  # places along each side of the picture
_MAX_ROUND_TRIP_PX = 1.0
_STEP = 1e-5  # of X and Y, for derivatives
# Chosen: corners may be folded, where no board was seen and polynomials do as they like; a port of
# flat glass under water enlarges small areas 40 degrees off the axis by 5.
_MAX_SHARE = 0.05
_MAX_ENLARGEMENT = 6.0


def require_lens(camera: Camera, path: Path) -> None:
    """Raise CalibrationError where a pinhole's distortion can't be a lens's.

    Within the ellipse that touches the picture's sides nearly every pixel must have a ray of its
    own, that leads back to it: a distortion whose radius shrinks further out folds the picture. And
    none may show small areas much larger than the middle does.
    """
    if camera.is_fisheye:  # rays end where its model folds
        return
    pixels, is_inside = _places(camera)
    rays = camera.back_project(pixels)
    gaps_px = np.linalg.norm(camera.project(rays) - pixels, axis=1)
    folded = float(np.mean(~(gaps_px < _MAX_ROUND_TRIP_PX)[is_inside]))
    if folded > _MAX_SHARE:
        raise CalibrationError(
            f"{path}: distortion_coefficients: expected those of a lens, got some that fold "
            f"{100 * folded:.0f} % of the picture onto other parts of it; {CALIBRATE}"
        )
    enlargement = float(_enlargements(rays[is_inside], camera).max())
    if not enlargement < _MAX_ENLARGEMENT:
        raise CalibrationError(
            f"{path}: distortion_coefficients: expected those of a lens, got some that enlarge "
            f"areas {enlargement:.0f} times towards the picture's sides; {CALIBRATE}"
        )


def _places(camera: Camera) -> tuple[Float[np.ndarray, "N 2"], Bool[np.ndarray, "N"]]:
    """Pixels all over the picture, row by row, and which lie in the ellipse."""
    half = np.array([camera.width - 1, camera.height - 1]) / 2
    x, y = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, _GRID)])
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    return half + half * places, (places**2).sum(axis=1) <= 1.0


def _enlargements(rays: Float[np.ndarray, "N 3"], camera: Camera) -> Float[np.ndarray, "N"]:
    """Areas in the picture over those that a lens without distortion would show.

    The determinant of the derivative of pixels by (X, Y), over the focal lengths.
    """
    by_x, by_y = (
        (camera.project(rays + step) - camera.project(rays - step)) / (2 * _STEP)
        for step in _STEP * np.eye(3)[:2]
    )
    return (
        np.abs(by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]) / camera.K[[0, 1], [0, 1]].prod()
    )
