"""Chooses between the pinhole and the fisheye model, leaves out views that disagree, and warns."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from stream_dmr.calibration.lens_fit import LensFit, fit_lens, require_determined
from stream_dmr.calibration.printed_board import BoardCorners
from stream_dmr.camera import Camera
from stream_dmr.errors import CalibrationError

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
    """A lens, the views that do not agree with it, and what is to be said of the choice."""

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
    """Fit a lens of the model that is asked for.

    "auto" takes the fisheye where it fits clearly better than the pinhole. Raises
    CalibrationError where the views determine no lens, or the plane's picture disagrees with the
    others.
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
    """Raise CalibrationError where too few views are left."""
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
    """What should be improved before the calibration is used."""
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
    boards: Mapping[Path, BoardCorners],
    size: tuple[int, int],
    plane_image: Path,
    *,
    is_fisheye: bool,
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
    boards: Mapping[Path, BoardCorners],
    size: tuple[int, int],
    plane_image: Path,
    *,
    is_fisheye: bool,
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
    """True where the rays through the picture's corners are not seen in its corners."""
    camera: Camera = fit.camera
    right, bottom = camera.width - 1, camera.height - 1
    rim = np.array([[0, 0], [right, 0], [0, bottom], [right, bottom]], np.float64)
    moved = camera.project(camera.back_project(rim)) - rim
    return bool(np.abs(moved).max() > _MAX_FOLD_PX)
