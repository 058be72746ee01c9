"""Fit a lens to boards, and choose its model."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from stream_dmr.calibration.corners import BoardCorners
from stream_dmr.camera import Camera, ReferencePlane
from stream_dmr.errors import CalibrationError


def find_plane(corners: BoardCorners, camera: Camera) -> tuple[ReferencePlane, float]:
    """The board's plane, and the RMS reprojection error in px.

    A planar target has a second, mirrored pose of almost the same error; IPPE (Collins and
    Bartoli, IJCV 2014) gives both from the rays, for any lens. The pose with the smaller error in
    the picture after refinement is taken.
    """
    rays = np.ascontiguousarray(camera.back_project(corners.pixels)[:, :2])
    _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        corners.points_mm, rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    starts = [np.concatenate([r.ravel(), t.ravel()]) for r, t in zip(rvecs, tvecs, strict=True)]
    return min((_refined(start, corners, camera) for start in starts), key=lambda found: found[1])


def _refined(
    start: Float[np.ndarray, "6"], corners: BoardCorners, camera: Camera
) -> tuple[ReferencePlane, float]:
    """The pose of least reprojection error near a start: rotation vector and translation."""

    def off_px(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "R"]:
        points = Rotation.from_rotvec(pose[:3]).apply(corners.points_mm) + pose[3:]
        return (camera.project(points) - corners.pixels).ravel()

    found = least_squares(off_px, start, method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12)
    rotation = Rotation.from_rotvec(found.x[:3]).as_matrix()
    plane = ReferencePlane(rotation=rotation, translation_mm=found.x[3:])
    return plane, float(np.sqrt(2 * found.cost / len(corners.pixels)))


MAX_FOCAL_STD = 0.01  # of the focal length; chosen: the views determine it within 1 %
# Between the normals of the two most different boards. The std alone is not enough: ten boards, all
# parallel to the sensor, fit any focal length equally well; one fit was 54 % wrong, its std 0.01 %.
MIN_TILT_DEG = 10.0
_FISHEYE_FLAGS = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
# Focal lengths over the picture's longer side from which a fisheye is searched, of 240 to 60
# degrees: from a single one, also OpenCV's own, the search often ends far from the lens.
_FISHEYE_STARTS = (0.24, 0.32, 0.42, 0.6, 0.9)
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

    Raises CalibrationError if the views leave the focal length undetermined.
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
    if abs(camera.distortion[4]) <= 3 * stds[8]:  # k3 and its standard deviation
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
    best, error = None, None
    for share in _FISHEYE_STARTS:
        try:
            found = _searched_fisheye(boards, size, share * max(size))
        except cv2.error as failure:
            error = failure
            continue
        if np.isfinite(found[0]) and (best is None or found[0] < best[0]):
            best = found
    if best is None:
        raise _undetermined("no finite solution") from error
    _, K, distortion, rvecs, tvecs = best
    K, distortion = np.asarray(K), np.asarray(distortion).ravel()
    try:
        stds = _fisheye_stds(boards, K, distortion, list(zip(rvecs, tvecs, strict=True)))
    except (cv2.error, np.linalg.LinAlgError) as failure:
        raise _undetermined("no finite solution") from failure
    _require_finite(K, distortion, stds)
    camera = Camera(width=size[0], height=size[1], K=K, distortion=distortion, is_fisheye=True)
    return camera, stds[:2]


def _searched_fisheye(
    boards: list[BoardCorners], size: tuple[int, int], focal_px: float
) -> "tuple[float, np.ndarray, np.ndarray, Sequence[np.ndarray], Sequence[np.ndarray]]":
    """RMS in px, K, distortion, and the poses of the boards. Raises cv2.error."""
    K = np.diag([focal_px, focal_px, 1.0])
    K[:2, 2] = (size[0] - 1) / 2, (size[1] - 1) / 2
    return cv2.fisheye.calibrate(
        [seen.points_mm.reshape(1, -1, 3) for seen in boards],
        [seen.pixels.reshape(1, -1, 2) for seen in boards],
        size,
        K,
        np.zeros(4),
        flags=_FISHEYE_FLAGS,
        criteria=_FISHEYE_UNTIL,
    )


def _fisheye_stds(
    boards: list[BoardCorners],
    K: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "4"],
    poses: "list[tuple[np.ndarray, np.ndarray]]",
) -> Float[np.ndarray, "8"]:
    """Standard deviations of fx fy cx cy k1 k2 k3 k4, which `cv2.fisheye.calibrate` doesn't return.

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


LensModel = Literal["auto", "pinhole", "fisheye"]

# Each view of a plane gives two constraints on the four parameters of K (Zhang 2000, Sec. 2.4), so
# two views would do; with five, each parameter is overdetermined and the residuals mean something.
MIN_VIEWS = 5
GOOD_VIEWS = 10
# The following are chosen by hand.
_OUTLIER = 3.0  # times the median RMS of all views
_OUTLIER_PX = 1.0  # below that no view is an outlier
_GOOD_RMS = 1 / 2000  # of the picture's longer side
_GOOD_COVERAGE = 0.4  # of the picture's area
_MAX_FOLD_PX = 1.0  # that a corner of the picture may move on its way to a ray and back
_WORTH_FISHEYE = 0.7  # of the pinhole's RMS: other programs read the pinhole's file only


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """One photograph that was not used, and why."""

    path: Path
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class ChosenFit:
    """A lens, the views that do not agree with it, and notes on the choice."""

    fit: LensFit
    outliers: tuple[LeftOut, ...]
    note: str = ""


def choose_fit(
    boards: Mapping[Path, BoardCorners],
    size: tuple[int, int],
    *,
    plane_image: Path,
    model: LensModel,
) -> ChosenFit:
    """Fit a lens of the requested model.

    "auto" takes the fisheye if it fits clearly better than the pinhole. Raises CalibrationError if
    the views determine no lens, or if the plane's picture disagrees with the others.
    """
    if model != "auto":
        return _without_outliers(boards, size, plane_image, is_fisheye=model == "fisheye")
    pinhole = _attempt(boards, size, plane_image, is_fisheye=False)
    fisheye = _attempt(boards, size, plane_image, is_fisheye=True)
    if isinstance(fisheye, ChosenFit) and _is_worth(fisheye, pinhole):
        before = "no fit" if isinstance(pinhole, Exception) else f"{pinhole.fit.rms_px:.2f} px"
        note = f"the fisheye model is used: {fisheye.fit.rms_px:.2f} px RMS; a pinhole: {before}"
        return replace(fisheye, note=note)
    if isinstance(pinhole, CalibrationError):
        raise pinhole
    return pinhole


def require_views(boards: int, left_out: list[LeftOut]) -> None:
    """Raise CalibrationError if too few views are left."""
    if boards >= MIN_VIEWS:
        return
    shown = [f"{left.path.name}: {left.reason}" for left in left_out[:5]]
    if len(left_out) > 5:
        shown.append(f"and {len(left_out) - 5} more")
    why = f" ({'; '.join(shown)})" if shown else ""
    raise CalibrationError(
        f"expected at least {MIN_VIEWS} different pictures that show the board, the plane's "
        f"included, got {boards}{why}; take more, {GOOD_VIEWS} to 20 are good, and check --board"
    )


def quality_warnings(fit: LensFit) -> Iterator[str]:
    camera = fit.camera
    if len(fit.views) < GOOD_VIEWS:
        yield f"only {len(fit.views)} views; {GOOD_VIEWS} to 20 determine the lens better"
    if _is_bad(fit):
        limit = _GOOD_RMS * max(camera.width, camera.height)
        wide = "" if camera.is_fisheye else "; or is it a very wide lens? then try --model fisheye"
        yield (
            f"the reprojection error of {fit.rms_px:.2f} px is above {limit:.2f} px; is the board "
            f"flat, and are the pictures sharp?{wide}"
        )
    seen = np.concatenate([view.corners.pixels for view in fit.views]).astype(np.float32)
    coverage = cv2.contourArea(cv2.convexHull(seen)) / (camera.width * camera.height)
    if coverage < _GOOD_COVERAGE:
        yield (
            f"the boards cover {coverage:.0%} of the picture; distortion is extrapolated outside "
            "of them, so show the board near all edges too"
        )
    if _folds_over(fit):
        yield (
            "the picture's corners see further than 85 degrees off the axis, or the lens model "
            "folds over there; nothing can be measured in them"
            if camera.is_fisheye
            else "the lens model folds over in the picture's corners; show the board near them too"
        )


def _attempt(
    boards: Mapping[Path, BoardCorners], size: tuple[int, int], plane_image: Path, is_fisheye: bool
) -> ChosenFit | CalibrationError:
    try:
        chosen = _without_outliers(boards, size, plane_image, is_fisheye=is_fisheye)
        require_determined(chosen.fit)
    except CalibrationError as error:
        return error
    return chosen


def _is_worth(fisheye: ChosenFit, pinhole: ChosenFit | CalibrationError) -> bool:
    if isinstance(pinhole, CalibrationError):
        return not _is_bad(fisheye.fit)
    is_better = fisheye.fit.rms_px < _WORTH_FISHEYE * pinhole.fit.rms_px
    return is_better and len(fisheye.outliers) <= len(pinhole.outliers)


def _without_outliers(
    boards: Mapping[Path, BoardCorners], size: tuple[int, int], plane_image: Path, is_fisheye: bool
) -> ChosenFit:
    fit = fit_lens(boards, size, is_fisheye=is_fisheye)
    outliers = _outliers(fit, plane_image)
    if outliers:
        gone = {outlier.path for outlier in outliers}
        kept = {path: seen for path, seen in boards.items() if path not in gone}
        require_views(len(kept), outliers)
        fit = fit_lens(kept, size, is_fisheye=is_fisheye)
    return ChosenFit(fit=fit, outliers=tuple(outliers))


def _outliers(fit: LensFit, plane_image: Path) -> list[LeftOut]:
    limit = max(_OUTLIER * float(np.median([view.rms_px for view in fit.views])), _OUTLIER_PX)
    bad = [view for view in fit.views if view.rms_px > limit]
    for view in bad:
        if view.path == plane_image:
            raise CalibrationError(
                f"--plane {plane_image}: expected corners within {limit:.1f} px of what the other "
                f"pictures say, got {view.rms_px:.1f} px: the board was bent or blurred, or the "
                "camera is another one; take that picture again"
            )
    return [
        LeftOut(path=view.path, reason=f"corners {view.rms_px:.1f} px off, the others fit better")
        for view in bad
    ]


def _is_bad(fit: LensFit) -> bool:
    return fit.rms_px > _GOOD_RMS * max(fit.camera.width, fit.camera.height)


def _folds_over(fit: LensFit) -> bool:
    """True if the rays through the picture's corners are not seen in its corners."""
    camera = fit.camera
    right, bottom = camera.width - 1, camera.height - 1
    rim = np.array([[0, 0], [right, 0], [0, bottom], [right, bottom]], np.float64)
    moved = camera.project(camera.back_project(rim)) - rim
    return bool(np.abs(moved).max() > _MAX_FOLD_PX)
