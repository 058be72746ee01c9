"""One fish seen by two cameras: its midline from both, the reference plane only between them.

Each camera's fit knows where the midline is in its picture: well across the body, less well which
point of it a pixel shows. A curve in space is fitted to both pictures with these two weights, so
neither the plane nor a fit's slant matters. Its ends are the triangulated head and tail.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration
from stream_dmr.geometry import arc_length, arc_lengths

_DEGREE = 4  # of the curve: a C, an S and a little more
_STATIONS = 17
# Std of a midline in a picture, over its length there: across the body; along it at the ends, whose
# place is seen, and between them, where a turned body is foreshortened unevenly.
_ACROSS, _ALONG_ENDS, _ALONG = 0.003, 0.007, 0.1
_RIDGE_STD = 1.0  # of the curve's coefficients, over the length, but for place and direction
_ROUNDS = 6
_STEP, _SETTLED = 1e-4, 1e-5  # of a numerical slope, of the last round; over the length


class View(NamedTuple):
    """What one camera saw of a fish at a moment."""

    midline_px: Float[np.ndarray, "M 2"]  # from head to tail, frame pixels
    calibration: Calibration


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed:
    """A midline in the first camera's frame, mm."""

    midline_mm: Float[np.ndarray, "S 3"]
    length_mm: float
    length_std_mm: float  # by the two pictures' errors
    misfit: float  # root mean square of the residuals, in their stds: 1 is expected


def second_from_first(
    first: Calibration, second: Calibration
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """R and t (mm) from the first camera's frame to the second's: both see the same plane."""
    R = second.plane.rotation @ first.plane.rotation.T
    return R, second.plane.translation_mm - R @ first.plane.translation_mm


def rays_apart(
    first: Float[np.ndarray, "*N 3"],
    second: Float[np.ndarray, "*N 3"],
    center_mm: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "*N"]:
    """Distances (mm) of rays from the origin and rays from `center_mm`, in one frame."""
    normal = np.cross(first, second)
    size = np.linalg.norm(normal, axis=-1)
    return np.abs(normal @ center_mm) / np.maximum(size, 1e-12)


def place_between(views: tuple[View, View], start_mm: Float[np.ndarray, "M 3"]) -> Placed:
    """Fit a curve to both pictures, from a midline in the first camera's frame (mm)."""
    scale = arc_length(start_mm)
    places = np.linspace(-1, 1, _STATIONS)
    basis = np.polynomial.legendre.legvander(places, _DEGREE)
    start = _at(start_mm, _STATIONS)
    coefficients = np.linalg.lstsq(basis, start, rcond=None)[0].ravel()
    frames = (np.eye(3), np.zeros(3)), second_from_first(*(view.calibration for view in views))
    targets = [_weights(view) for view in views]
    ridge = np.repeat((np.arange(_DEGREE + 1) > 1) / (_RIDGE_STD * scale), 3)

    def residuals(x: Float[np.ndarray, "C"]) -> Float[np.ndarray, "R"]:
        curve = basis @ x.reshape(-1, 3)
        parts = [
            np.einsum("sij,sj->si", weights, view.calibration.camera.project(curve @ R.T + t) - px)
            for view, (R, t), (px, weights) in zip(views, frames, targets, strict=True)
        ]
        return np.concatenate([*(part.ravel() for part in parts), ridge * x])

    shifts = _STEP * scale * np.eye(coefficients.size)

    def slopes(
        of: Callable[[Float[np.ndarray, "C"]], Float[np.ndarray, "R"]], x: Float[np.ndarray, "C"]
    ) -> Float[np.ndarray, "R C"]:
        return np.stack([(of(x + d) - of(x - d)) / (2 * _STEP * scale) for d in shifts], axis=-1)

    J = slopes(residuals, coefficients)
    for _ in range(_ROUNDS):
        step = np.linalg.solve(J.T @ J, J.T @ residuals(coefficients))
        coefficients = coefficients - step
        J = slopes(residuals, coefficients)
        if np.abs(step).max() < _SETTLED * scale:
            break
    dense = np.polynomial.legendre.legvander(np.linspace(-1, 1, len(start_mm)), _DEGREE)

    def length(x: Float[np.ndarray, "C"]) -> Float[np.ndarray, "1"]:
        return np.array([arc_length(dense @ x.reshape(-1, 3))])

    slope = slopes(length, coefficients)[0]
    left = residuals(coefficients)[: -ridge.size]
    return Placed(
        midline_mm=dense @ coefficients.reshape(-1, 3),
        length_mm=float(length(coefficients)[0]),
        length_std_mm=float(np.sqrt(slope @ np.linalg.solve(J.T @ J, slope))),
        misfit=float(np.sqrt(np.mean(left**2))),
    )


def _at(line: Float[np.ndarray, "M D"], num: int) -> Float[np.ndarray, "S D"]:
    """Points of a polyline at equal parts of its length."""
    arc = arc_lengths(line)
    places = np.linspace(0, arc[-1], num)
    return np.column_stack([np.interp(places, arc, axis) for axis in line.T])


def _weights(view: View) -> tuple[Float[np.ndarray, "S 2"], Float[np.ndarray, "S 2 2"]]:
    """Points of a midline in the picture, and what their residuals are multiplied by."""
    line = _at(view.midline_px, _STATIONS)
    length_px = arc_length(view.midline_px)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    along_std = np.full(_STATIONS, _ALONG)
    along_std[[0, -1]] = _ALONG_ENDS
    weights = np.stack([along / along_std[:, None], across / _ACROSS], axis=1) / length_px
    return line, weights
