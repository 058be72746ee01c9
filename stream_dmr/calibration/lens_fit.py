"""Fit of a lens and of each board's plane to the corners found in photographs."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import pdist

from stream_dmr.calibration.board_pose import find_plane
from stream_dmr.calibration.printed_board import BoardCorners
from stream_dmr.camera import Camera, ReferencePlane
from stream_dmr.errors import CalibrationError

MAX_FOCAL_STD = 0.01  # of the focal length; chosen: the views determine it within 1 %
# Between the normals of the two most different boards. The std alone is not enough: ten boards, all
# parallel to the sensor, fit any focal length equally well; one was 54 % wrong, its std 0.01 %.
MIN_TILT_DEG = 10.0
_FISHEYE_FLAGS = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
_FISHEYE_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-10)
_NUM_INTRINSICS = 8  # of a fisheye: fx fy cx cy k1 k2 k3 k4


@dataclass(frozen=True, kw_only=True)
class DistanceErrors:
    """Measured minus known distance, over all pairs of corners of one board, absolute values."""

    mean_mm: float
    max_mm: float
    mean_percent: float
    max_percent: float


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardView:
    """One photograph that was used."""

    path: Path
    corners: BoardCorners
    plane: ReferencePlane  # in which the board lies
    rms_px: float  # reprojection error: root mean square distance of corners
    distances: DistanceErrors

    @classmethod
    def measured(cls, path: Path, corners: BoardCorners, camera: Camera) -> "BoardView":
        """The board's plane by its corners, and the errors of both."""
        plane, rms_px = find_plane(corners, camera)
        distances = _distance_errors(corners, camera, plane)
        return cls(path=path, corners=corners, plane=plane, rms_px=rms_px, distances=distances)


@dataclass(frozen=True, eq=False, kw_only=True)
class LensFit:
    """A camera, and how well the views determine it and agree with it."""

    camera: Camera
    focal_std_px: Float[np.ndarray, "2"]  # of fx and fy
    views: tuple[BoardView, ...]

    @property
    def rms_px(self) -> float:
        """Reprojection error over all corners of all views."""
        counts = [len(view.corners.pixels) for view in self.views]
        squares = [view.rms_px**2 for view in self.views]
        return float(np.sqrt(np.average(squares, weights=counts)))


def fit_lens(
    boards: Mapping[Path, BoardCorners], size: tuple[int, int], *, is_fisheye: bool = False
) -> LensFit:
    """Fit intrinsics, distortion and each board's plane to the corners seen in each picture.

    `size` is the pictures' (width, height). The distortion of a pinhole is k1 k2 p1 p2, with k3
    only where it is 3 of its standard deviations from zero: fitted to noise, it would distort the
    picture's edges, where no board was seen. That of a fisheye is k1 k2 k3 k4.

    Raises CalibrationError where the views leave the focal length undetermined.
    """
    fit = _fit_fisheye if is_fisheye else _fit_pinhole
    camera, focal_std_px = fit(list(boards.values()), size)
    views = tuple(BoardView.measured(path, seen, camera) for path, seen in boards.items())
    return LensFit(camera=camera, focal_std_px=focal_std_px, views=views)


def require_determined(fit: LensFit) -> None:
    """Raise CalibrationError unless the boards' tilts determine the focal length."""
    normals = np.stack([view.plane.rotation[:, 2] for view in fit.views])
    tilt_deg = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max())
    if tilt_deg < MIN_TILT_DEG:
        raise _undetermined(f"boards that differ by {tilt_deg:.0f} degrees at most")
    relative = float(np.max(fit.focal_std_px / fit.camera.K[[0, 1], [0, 1]]))
    if not relative <= MAX_FOCAL_STD:
        raise _undetermined(f"a standard deviation of {relative:.1%}")


def _undetermined(got: str) -> CalibrationError:
    return CalibrationError(
        f"expected boards tilted to different sides, which give the focal length within "
        f"{MAX_FOCAL_STD:.0%}, got {got}; add pictures with the board tilted by 20 to 40 degrees "
        "to the left, right, top and bottom"
    )


def _require_finite(*parts: np.ndarray) -> None:
    if not all(np.isfinite(part).all() for part in parts):
        raise _undetermined("no finite solution")


def _fit_pinhole(
    boards: list[BoardCorners], size: tuple[int, int]
) -> tuple[Camera, Float[np.ndarray, "2"]]:
    camera, stds = _calibrate_pinhole(boards, size, flags=0)
    k3, k3_std = camera.distortion[4], stds[8]
    if abs(k3) <= 3 * k3_std:
        camera, stds = _calibrate_pinhole(boards, size, flags=cv2.CALIB_FIX_K3)
    return camera, stds[:2]


def _calibrate_pinhole(
    boards: list[BoardCorners], size: tuple[int, int], *, flags: int
) -> tuple[Camera, Float[np.ndarray, "S"]]:
    """Return the camera, and the standard deviations of fx fy cx cy k1 k2 p1 p2 k3 ..."""
    try:
        _, K, distortion, _, _, stds, _, _ = cv2.calibrateCameraExtended(
            [seen.points_mm.astype(np.float32) for seen in boards],
            [seen.pixels.astype(np.float32) for seen in boards],
            size,
            np.eye(3),
            np.zeros(5),
            flags=flags,
        )
    except cv2.error as error:
        raise _undetermined("no finite solution") from error
    _require_finite(K, distortion, stds)
    return Camera(width=size[0], height=size[1], K=K, distortion=distortion.ravel()), stds.ravel()


def _fit_fisheye(
    boards: list[BoardCorners], size: tuple[int, int]
) -> tuple[Camera, Float[np.ndarray, "2"]]:
    try:
        _, K, distortion, rvecs, tvecs = cv2.fisheye.calibrate(
            [seen.points_mm.reshape(1, -1, 3) for seen in boards],
            [seen.pixels.reshape(1, -1, 2) for seen in boards],
            size,
            np.zeros((3, 3)),
            np.zeros(4),
            flags=_FISHEYE_FLAGS,
            criteria=_FISHEYE_UNTIL,
        )
        K, distortion = np.asarray(K), np.asarray(distortion).ravel()
        stds = _fisheye_stds(boards, K, distortion, list(zip(rvecs, tvecs, strict=True)))
    except (cv2.error, np.linalg.LinAlgError) as error:
        raise _undetermined("no finite solution") from error
    _require_finite(K, distortion, stds)
    camera = Camera(width=size[0], height=size[1], K=K, distortion=distortion, is_fisheye=True)
    return camera, stds[:2]


def _fisheye_stds(
    boards: list[BoardCorners],
    K: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "4"],
    poses: "list[tuple[np.ndarray, np.ndarray]]",
) -> Float[np.ndarray, "8"]:
    """Standard deviations of fx fy cx cy k1 k2 k3 k4, which `cv2.fisheye.calibrate` does not give.

    sigma^2 (J^T J)^-1, the poses of the boards eliminated by the Schur complement.
    """
    normal, squares, freedom = np.zeros((_NUM_INTRINSICS, _NUM_INTRINSICS)), 0.0, -_NUM_INTRINSICS
    for seen, (rvec, tvec) in zip(boards, poses, strict=True):
        pixels, jacobian = cv2.fisheye.projectPoints(
            seen.points_mm.reshape(-1, 1, 3), rvec, tvec, K, distortion
        )
        lens, pose = jacobian[:, :_NUM_INTRINSICS], jacobian[:, _NUM_INTRINSICS:][:, :6]
        coupled = lens.T @ pose
        normal += lens.T @ lens - coupled @ np.linalg.solve(pose.T @ pose, coupled.T)
        squares += float(np.sum((pixels.reshape(-1, 2) - seen.pixels) ** 2))
        freedom += pixels.size - 6
    variances = np.diag(np.linalg.inv(normal)) * squares / max(freedom, 1)
    return np.sqrt(np.maximum(variances, 0.0))


def _distance_errors(
    corners: BoardCorners, camera: Camera, plane: ReferencePlane
) -> DistanceErrors:
    """Errors of distances between corners that are back-projected onto the plane, as fish are."""
    rays = camera.back_project(corners.pixels)
    measured = pdist(rays * plane.depth_mm(rays)[:, None])
    known = pdist(corners.points_mm)
    errors = np.abs(measured - known)
    return DistanceErrors(
        mean_mm=float(errors.mean()),
        max_mm=float(errors.max()),
        mean_percent=float(100 * (errors / known).mean()),
        max_percent=float(100 * (errors / known).max()),
    )
