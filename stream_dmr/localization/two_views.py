"""One fish seen by two cameras: its midline from both, the reference plane only between them.

Each camera's fit knows where the midline is in its picture: well across the body, less well which
point of it a pixel shows. A curve in space is fitted to both pictures with these two weights, so
neither the plane nor a fit's slant matters. Its ends are the triangulated head and tail.

A fit that fails ends short: of a fish seen on edge it leaves out the tail. So the ends of a fit of
low IoU weigh less, and where the two pictures contradict each other, those that are short do.

A tail that the fish's own body hides is in neither picture, and nothing there contradicts. But a
mesh that fits both masks (`stream_dmr.fitting.two_masks`) knows where it hides, and how long a fish
of this breadth is. `agreed` weighs the two lengths.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration
from stream_dmr.geometry import arc_length, points_along

_DEGREE = 4  # of the curve: a C, an S and a little more
_STATIONS = 17
_SHARES = np.linspace(0, 1, _STATIONS)  # of the midline, at which it is compared
# Std of a midline in a picture, over its length there: across the body; along it at the ends, whose
# place is seen, and between them, where a turned body is foreshortened unevenly.
_ACROSS, _ALONG_ENDS, _ALONG = 0.003, 0.005, 0.1
# Of the ends at an IoU of 0.9, in any direction; it falls with the cube of what is missing. And
# the share of it that the midline between the ends is off, across the body.
_MISFIT_STD, _ACROSS_SHARE = 0.03, 0.2
_SHORT = 0.7  # stds by which a picture may be short at both ends before they weigh less
_DOUBT = 1.5  # misfit that adds as much to the length's std as the two pictures' errors
# Of the common mesh's log length, by 1 - IoU. And of the curve's by how far the two lengths differ,
# as a log, beyond what is usual. Chosen on simulated pairs.
_MESH_SHARE, _USUAL, _DIFFERENCE_SHARE = 0.3, 0.02, 3.0
_RIDGE_STD = 1.0  # of the curve's coefficients, over the length, but for place and direction
# The same along the first camera's line of sight, which cameras that stand close together hardly
# see: fish slant by some 17 degrees, and bend in depth as they do across it. Chosen.
_DEPTH_STDS = (0.15, 0.1, 0.05, 0.03)
_ROUNDS = 10
_STEP, _SETTLED = 1e-4, 1e-5  # of a numerical slope, of the last round; over the length


# Points of a midline in the picture, and what their residuals are multiplied by.
_Target = tuple[Float[np.ndarray, "S 2"], Float[np.ndarray, "S 2 2"]]


class View(NamedTuple):
    """What one camera saw of a fish at a moment."""

    midline_px: Float[np.ndarray, "M 2"]  # from head to tail, frame pixels
    center_px: Float[np.ndarray, "2"]
    calibration: Calibration
    iou: float = 1.0  # of the fit, with its mask


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed:
    """A midline in the first camera's frame, mm."""

    midline_mm: Float[np.ndarray, "S 3"]
    length_mm: float
    length_std_mm: float  # by the pictures' errors, and by how they contradict each other
    misfit: float  # root mean square of the residuals, in the stds of good fits: 1 is expected


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
    basis = np.polynomial.legendre.legvander(2 * _SHARES - 1, _DEGREE)
    start = points_along(start_mm, _SHARES)
    coefficients = np.linalg.lstsq(basis, start, rcond=None)[0].ravel()
    frames = (np.eye(3), np.zeros(3)), second_from_first(*(view.calibration for view in views))
    targets = [_weights(view) for view in views]
    good = [_weights(view._replace(iou=1.0)) for view in views]
    ridge = np.repeat((np.arange(_DEGREE + 1) > 1) / (_RIDGE_STD * scale), 3)
    sight = start.mean(axis=0) / np.linalg.norm(start.mean(axis=0))
    depths = np.kron(np.diag(1 / (np.array([np.inf, *_DEPTH_STDS]) * scale)), sight)

    def misses(x: Float[np.ndarray, "C"], given: list[_Target]) -> Float[np.ndarray, "2 S 2"]:
        curve = basis @ x.reshape(-1, 3)
        return np.stack(
            [
                np.einsum("sij,sj->si", w, view.calibration.camera.project(curve @ R.T + t) - px)
                for view, (R, t), (px, w) in zip(views, frames, given, strict=True)
            ]
        )

    def residuals(x: Float[np.ndarray, "C"]) -> Float[np.ndarray, "R"]:
        return np.concatenate([(trust * misses(x, targets)).ravel(), ridge * x, depths @ x])

    shifts = _STEP * scale * np.eye(coefficients.size)

    def slopes(
        of: Callable[[Float[np.ndarray, "C"]], Float[np.ndarray, "R"]], x: Float[np.ndarray, "C"]
    ) -> Float[np.ndarray, "R C"]:
        return np.stack([(of(x + d) - of(x - d)) / (2 * _STEP * scale) for d in shifts], axis=-1)

    trust = np.ones((2, _STATIONS, 1))
    for _ in range(_ROUNDS):
        # How far the curve goes on beyond a picture's two ends, along the body. Of both together:
        # a picture that is shifted along the body, as by a late clock, is not short.
        beyond = misses(coefficients, targets)[:, [0, -1], 0] @ [-0.5, 0.5]
        trust[:, [0, -1], 0] = 1 / np.hypot(1, np.maximum(beyond, 0) / _SHORT)[:, None]
        J = slopes(residuals, coefficients)
        step = np.linalg.solve(J.T @ J, J.T @ residuals(coefficients))
        coefficients = coefficients - step
        if np.abs(step).max() < _SETTLED * scale:
            break
    dense = np.polynomial.legendre.legvander(np.linspace(-1, 1, len(start_mm)), _DEGREE)

    def length(x: Float[np.ndarray, "C"]) -> Float[np.ndarray, "1"]:
        return np.array([arc_length(dense @ x.reshape(-1, 3))])

    slope = slopes(length, coefficients)[0]
    J = slopes(residuals, coefficients)
    misfit = float(np.sqrt(np.mean(misses(coefficients, good) ** 2)))
    std_mm = float(np.sqrt(slope @ np.linalg.solve(J.T @ J, slope)))
    return Placed(
        midline_mm=dense @ coefficients.reshape(-1, 3),
        length_mm=float(length(coefficients)[0]),
        length_std_mm=std_mm * float(np.hypot(1, misfit / _DOUBT)),
        misfit=misfit,
    )


def agreed(curve: Placed, mesh_mm: Float[np.ndarray, "M 3"], iou: float) -> Placed:
    """The curve and the midline of a mesh that fits both masks with an IoU, weighed.

    The midline of the surer of the two, with the length of both. Their errors are taken to be
    alike: a mask that lacks an end shortens both.
    """
    lengths_mm = np.array([curve.length_mm, arc_length(mesh_mm)])
    difference = abs(float(np.log(lengths_mm[0] / lengths_mm[1])))
    doubt = _DIFFERENCE_SHARE * max(difference - _USUAL, 0.0)
    stds = np.array(
        [np.hypot(curve.length_std_mm / curve.length_mm, doubt), _MESH_SHARE * (1 - iou)]
    )
    weights = np.maximum(stds, 1e-6) ** -2
    weights /= weights.sum()
    length_mm = float(np.exp(weights @ np.log(lengths_mm)))
    line_mm = curve.midline_mm if weights[0] > weights[1] else mesh_mm
    middle = line_mm.mean(axis=0)
    return replace(
        curve,
        midline_mm=middle + length_mm / arc_length(line_mm) * (line_mm - middle),
        length_mm=length_mm,
        length_std_mm=float(weights @ stds) * length_mm,
    )


def _weights(view: View) -> _Target:
    line = points_along(view.midline_px, _SHARES)
    length_px = arc_length(view.midline_px)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    stds = np.full((_STATIONS, 2, 1), [[_ALONG], [_ACROSS]])
    misfit_std = _MISFIT_STD * ((1 - view.iou) / 0.1) ** 3
    stds[:, 1] = np.hypot(_ACROSS, _ACROSS_SHARE * misfit_std)
    stds[[0, -1]] = np.hypot([[_ALONG_ENDS], [_ACROSS]], misfit_std)
    return line, np.stack([along, across], axis=1) / stds / length_px
