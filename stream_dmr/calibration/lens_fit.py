"""Fit of a lens and of each board's plane to the corners found in photographs."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import pdist

from stream_dmr.camera import Camera, ReferencePlane
from stream_dmr.errors import CalibrationError

MAX_FOCAL_STD = 0.01  # of the focal length; chosen: the views determine it within 1 %
# Between the normals of the two most different boards. The std alone is not enough: ten boards, all
# parallel to the sensor, fit any focal length equally well; one was 54 % wrong, its std 0.01 %.
MIN_TILT_DEG = 10.0


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
    corners_px: Float[np.ndarray, "N 2"]
    plane: ReferencePlane  # in which the board lies
    rms_px: float  # reprojection error: root mean square distance of corners
    distances: DistanceErrors


@dataclass(frozen=True, eq=False, kw_only=True)
class LensFit:
    """A camera, and how well the views determine it and agree with it."""

    camera: Camera
    focal_std_px: Float[np.ndarray, "2"]  # of fx and fy
    views: tuple[BoardView, ...]

    @property
    def rms_px(self) -> float:
        """Reprojection error over all views; all have the same number of corners."""
        return float(np.sqrt(np.mean([view.rms_px**2 for view in self.views])))


def fit_lens(
    corners: dict[Path, np.ndarray], points: Float[np.ndarray, "N 3"], size: tuple[int, int]
) -> LensFit:
    """Fit intrinsics, distortion and each board's plane to `corners`, (N, 2) for each picture.

    `points` are the corners on the board in mm, `size` is the pictures' (width, height). Distortion
    is k1 k2 p1 p2, with k3 only where it is 3 of its standard deviations from zero: fitted to
    noise, it would distort the picture's edges, where no board was seen.

    Raises CalibrationError where the views leave the focal length undetermined.
    """
    found = list(corners.values())
    camera, stds = _calibrate_camera(found, points, size, flags=0)
    k3, k3_std = camera.distortion[4], stds[8]
    if abs(k3) <= 3 * k3_std:
        camera, stds = _calibrate_camera(found, points, size, flags=cv2.CALIB_FIX_K3)
    views = tuple(_measure(path, found, points, camera) for path, found in corners.items())
    return LensFit(camera=camera, focal_std_px=stds[:2], views=views)


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


def _calibrate_camera(
    corners: list[np.ndarray],
    points: Float[np.ndarray, "N 3"],
    size: tuple[int, int],
    *,
    flags: int,
) -> tuple[Camera, Float[np.ndarray, "S"]]:
    """Return the camera, and the standard deviations of fx fy cx cy k1 k2 p1 p2 k3 ..."""
    try:
        _, K, distortion, _, _, stds, _, _ = cv2.calibrateCameraExtended(
            [points.astype(np.float32)] * len(corners),
            [found.astype(np.float32) for found in corners],
            size,
            np.eye(3),
            np.zeros(5),
            flags=flags,
        )
    except cv2.error as error:
        raise _undetermined("no finite solution") from error
    if not (np.isfinite(K).all() and np.isfinite(distortion).all() and np.isfinite(stds).all()):
        raise _undetermined("no finite solution")
    return Camera(width=size[0], height=size[1], K=K, distortion=distortion.ravel()), stds.ravel()


def _measure(
    path: Path, found: Float[np.ndarray, "N 2"], points: Float[np.ndarray, "N 3"], camera: Camera
) -> BoardView:
    plane, rms_px = _find_plane(found, points, camera)
    return BoardView(
        path=path,
        corners_px=found,
        plane=plane,
        rms_px=rms_px,
        distances=_distance_errors(found, points, camera, plane),
    )


def _find_plane(
    found: Float[np.ndarray, "N 2"], points: Float[np.ndarray, "N 3"], camera: Camera
) -> tuple[ReferencePlane, float]:
    """The board's plane, and the RMS reprojection error in px.

    A planar target has a second, mirrored pose of almost the same error; IPPE (Collins and
    Bartoli, IJCV 2014) gives both, and the one with the smaller error after refinement is taken.
    """
    _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        points, found, camera.K, camera.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    candidates: list[tuple[ReferencePlane, float]] = []
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        rvec, tvec = cv2.solvePnPRefineLM(points, found, camera.K, camera.distortion, rvec, tvec)
        plane = ReferencePlane(rotation=cv2.Rodrigues(rvec)[0], translation_mm=tvec.ravel())
        seen = camera.project(points @ plane.rotation.T + plane.translation_mm)
        rms_px = float(np.sqrt(np.mean(np.sum((seen - found) ** 2, axis=1))))
        candidates.append((plane, rms_px))
    return min(candidates, key=lambda candidate: candidate[1])


def _distance_errors(
    found: Float[np.ndarray, "N 2"],
    points: Float[np.ndarray, "N 3"],
    camera: Camera,
    plane: ReferencePlane,
) -> DistanceErrors:
    """Errors of distances between corners that are back-projected onto the plane, as fish are."""
    rays = camera.back_project(found)
    measured = pdist(rays * plane.depth_mm(rays)[:, None])
    known = pdist(points)
    errors = np.abs(measured - known)
    return DistanceErrors(
        mean_mm=float(errors.mean()),
        max_mm=float(errors.max()),
        mean_percent=float(100 * (errors / known).mean()),
        max_percent=float(100 * (errors / known).max()),
    )
