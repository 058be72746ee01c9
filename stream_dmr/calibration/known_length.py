"""Measure a known length in the reference plane: a chessboard, or a rod by its ends."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.distance import pdist

from stream_dmr.calibration.corners import PrintedBoard
from stream_dmr.camera import Calibration, Camera
from stream_dmr.errors import CalibrationError


@dataclass(frozen=True, kw_only=True)
class ScaleError:
    """Measured minus known lengths, over all distances that are known."""

    known_mm: float  # the longest of them
    error_mm: float  # of the longest
    error_percent: float  # mean over all, with its sign: a wrong scale shows here
    worst_percent: float  # the largest, absolute


def scale_of_points(
    points_px: Float[np.ndarray, "N 2"],
    known_mm: Float[np.ndarray, "N 3"],
    calibration: Calibration,
) -> ScaleError:
    """Compare all distances of points that lie in the reference plane, as pixels and in mm.

    Pixels are put onto the plane as a fish's keypoints would be that lay in it.
    """
    rays = calibration.camera.back_project(points_px)
    measured = pdist(rays * calibration.plane.depth_mm(rays)[:, None])
    known = pdist(known_mm)
    percent, longest = 100 * (measured / known - 1), int(np.argmax(known))
    return ScaleError(
        known_mm=float(known[longest]),
        error_mm=float(measured[longest] - known[longest]),
        error_percent=float(percent.mean()),
        worst_percent=float(np.abs(percent).max()),
    )


def scale_of_ends(
    ends_px: Float[np.ndarray, "2 2"], length_mm: float, calibration: Calibration
) -> ScaleError:
    """The scale by a rod's ends in the picture. Raises CalibrationError for ends that it hasn't."""
    require_ends(ends_px, length_mm, calibration.camera)
    return scale_of_points(ends_px, np.array([[0.0, 0, 0], [length_mm, 0, 0]]), calibration)


def require_ends(ends_px: Float[np.ndarray, "2 2"], length_mm: float, camera: Camera) -> None:
    """Raise CalibrationError unless these are two points of a camera's picture, and a length."""
    middles = np.array([camera.width - 1, camera.height - 1])  # of the last pixels
    if not ((ends_px >= -0.5) & (ends_px <= middles + 0.5)).all():
        raise CalibrationError(
            f"--ends: expected two points of the picture, {camera.width}x{camera.height} px, got "
            f"{_pixels(ends_px)}"
        )
    if (ends_px[0] == ends_px[1]).all():
        raise CalibrationError(
            f"--ends: expected the two ends of the rod, got the same point twice, "
            f"{_pixels(ends_px[:1])}"
        )
    if not 0 < length_mm < np.inf:
        raise CalibrationError(f"--length-mm: expected the rod's length, got {length_mm:g}")


def _pixels(points_px: Float[np.ndarray, "N 2"]) -> str:
    return " and ".join(f"({u:g}, {v:g})" for u, v in points_px)


def scale_of_board(
    pictures: Iterable[UInt8[np.ndarray, "H W"]], calibration: Calibration, board: PrintedBoard
) -> ScaleError:
    """The scale by the first picture that shows the board. Raises CalibrationError."""
    why = ""
    for picture in pictures:
        corners = board.find(picture)
        if corners is not None:
            return scale_of_points(corners.pixels, corners.points_mm, calibration)
        why = why or board.not_found(picture)
    raise CalibrationError(f"expected a picture with the board in the reference plane, got: {why}")
