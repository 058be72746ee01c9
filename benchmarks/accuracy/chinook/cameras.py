"""The camera of each photograph, from the grid alone: focal length, tilt and distance."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from benchmarks.accuracy.chinook.grid import Grid
from stream_dmr.camera import Camera

CELL_MM = 6.35  # a quarter of an inch, as such grids are sold; lengths are compared in cells
_FIRST_GUESS_PX = 1100.0  # of a phone's main camera at 1600 px, 24 mm equivalent
# One focal length for all, the middle of the picture, no distortion: k1 would be 0.02.
_HELD = (
    cv2.CALIB_USE_INTRINSIC_GUESS
    | cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_FIX_PRINCIPAL_POINT
    | cv2.CALIB_ZERO_TANGENT_DIST
    | cv2.CALIB_FIX_K1
    | cv2.CALIB_FIX_K2
    | cv2.CALIB_FIX_K3
)


@dataclass(frozen=True, eq=False, kw_only=True)
class GridPose:
    """Where the grid is, seen from the camera."""

    normal: Float[np.ndarray, "3"]  # away from the camera, unit
    distance_mm: float  # of the camera from the grid's plane


def shared_camera(grids: Sequence[Grid], *, size: tuple[int, int]) -> Camera:
    """One pinhole for pictures of `size` (width, height): Zhang's calibration with every grid."""
    middle = [(side - 1) / 2 for side in size]
    guess = np.array([[_FIRST_GUESS_PX, 0, middle[0]], [0, _FIRST_GUESS_PX, middle[1]], [0, 0, 1]])
    points = [_points_mm(grid).astype(np.float32) for grid in grids]
    pixels = [grid.crossings_px.astype(np.float32) for grid in grids]
    _, K, *_ = cv2.calibrateCamera(points, pixels, size, guess, np.zeros(5), flags=_HELD)
    return Camera(width=size[0], height=size[1], K=K, distortion=np.zeros(5))


def grid_pose(grid: Grid, camera: Camera) -> GridPose:
    """The plane of a grid, by its crossings."""
    points, pixels = _points_mm(grid), grid.crossings_px
    _, turn, shift = cv2.solvePnP(points, pixels, camera.K, None, flags=cv2.SOLVEPNP_IPPE)
    turn, shift = cv2.solvePnPRefineLM(points, pixels, camera.K, None, turn, shift)
    normal = cv2.Rodrigues(turn)[0][:, 2]
    distance_mm = float(normal @ shift.ravel())
    sign = 1.0 if distance_mm > 0 else -1.0
    return GridPose(normal=sign * normal, distance_mm=sign * distance_mm)


def facing_view(pose: GridPose, camera: Camera, view: Camera) -> Float[np.ndarray, "3 3"]:
    """The homography to what a camera in the same place sees that looks squarely at the grid."""
    axis = np.cross(pose.normal, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    turned = cv2.Rodrigues(axis * (np.arcsin(sine) / max(sine, 1e-12)))[0]
    return view.K @ turned @ np.linalg.inv(camera.K)


def _points_mm(grid: Grid) -> Float[np.ndarray, "N 3"]:
    return np.column_stack([CELL_MM * grid.cells, np.zeros(len(grid.cells))])
