"""Calibrates a camera and its reference plane from photographs of a chessboard."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from stream_dmr.calibration.corners import (
    Board,
    board_points_mm,
    draw_corners,
    find_corners,
    parse_board,
    read_grey,
    seen_board,
)
from stream_dmr.calibration.lens_fit import BoardView, LensFit, fit_lens, require_determined
from stream_dmr.camera import Calibration
from stream_dmr.errors import CalibrationError, OutputError

__all__ = ["BoardResult", "calibrate", "draw_views", "parse_board"]

# Each view of a plane gives two constraints on the four parameters of K (Zhang 2000, Sec. 2.4), so
# two views would do; with five, each parameter is overdetermined and the residuals mean something.
MIN_VIEWS = 5
GOOD_VIEWS = 10
# The following are chosen by hand.
_SAME_VIEW = 0.01  # of the picture's diagonal: closer boards add no information
_OUTLIER = 3.0  # times the median RMS of all views
_OUTLIER_PX = 1.0  # below that no view is an outlier
_GOOD_RMS = 1 / 2000  # of the picture's longer side
_GOOD_COVERAGE = 0.4  # of the picture's area


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """One photograph that was not used, and why."""

    path: Path
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardResult:
    """The calibration and what is needed to judge it."""

    calibration: Calibration
    board: Board
    fit: LensFit  # with the views and their reprojection errors
    plane_view: BoardView  # the view whose board lies in the reference plane
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]


def calibrate(
    image_paths: Iterable[Path | str],
    *,
    plane_image: Path | str,
    board: Board = (9, 6),
    square_mm: float = 25.0,
) -> BoardResult:
    """Calibrate the camera from all pictures, and the reference plane from `plane_image`.

    `board` counts inner corners. In `plane_image` the board lies in the reference plane; that
    picture serves for the lens as well, listed among `image_paths` or not. Zhang, "A Flexible New
    Technique for Camera Calibration", PAMI 2000, as OpenCV does it.

    Raises CalibrationError where the plane's picture is unusable, fewer than MIN_VIEWS pictures
    show the board, or the views are too much alike to determine the focal length.
    """
    if not (np.isfinite(square_mm) and square_mm > 0):
        raise CalibrationError(
            f"--square-mm: expected the side of one square in mm, above 0, got {square_mm:g}"
        )
    plane_image = Path(plane_image)
    corners, size, left_out = _find_boards(image_paths, plane_image, board)
    points = board_points_mm(board, square_mm)
    _require_views(corners, left_out)
    fit = fit_lens(corners, points, size)
    if outliers := _outliers(fit, plane_image):
        left_out += outliers
        for outlier in outliers:
            del corners[outlier.path]
        _require_views(corners, left_out)
        fit = fit_lens(corners, points, size)
    require_determined(fit)
    plane_view = next(view for view in fit.views if view.path == plane_image)
    return BoardResult(
        calibration=Calibration(camera=fit.camera, plane=plane_view.plane),
        board=board,
        fit=fit,
        plane_view=plane_view,
        left_out=tuple(left_out),
        warnings=tuple(_warnings(fit)),
    )


def draw_views(result: BoardResult, folder: Path) -> None:
    """Write a picture of each view with its corners drawn, for a check by eye.

    Raises OutputError where the folder can't be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number, view in enumerate(result.fit.views, start=1):
            out = folder / f"{number:02d}_{view.path.stem}.png"  # two folders may share a name
            draw_corners(view.path, view.corners_px, result.board, out)
    except OSError as error:
        raise OutputError(
            f"{folder}: expected a folder to draw the corners into, got: {error.strerror}"
        ) from error


def _find_boards(
    image_paths: Iterable[Path | str], plane_image: Path, board: Board
) -> tuple[dict[Path, np.ndarray], tuple[int, int], list[LeftOut]]:
    """Corners (N, 2) in px by picture, the plane's first; its (width, height); those left out."""
    try:
        picture = read_grey(plane_image)
        plane_corners = _corners_or_refuse(picture, board)
    except CalibrationError as error:
        raise CalibrationError(
            f"--plane {plane_image}: expected a picture of the whole board lying in the reference "
            f"plane, got: {_reason(error, plane_image)}; take that picture again"
        ) from error
    size = (picture.shape[1], picture.shape[0])
    corners, left_out, seen = {plane_image: plane_corners}, [], {plane_image.resolve()}
    for path in map(Path, image_paths):
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        try:
            picture = read_grey(path)
            _refuse_other_size(picture, size)
            found = _corners_or_refuse(picture, board)
            _refuse_same_view(found, corners, diagonal_px=np.hypot(*size))
            corners[path] = found
        except CalibrationError as error:
            left_out.append(LeftOut(path=path, reason=_reason(error, path)))
    return corners, size, left_out


def _reason(error: CalibrationError, path: Path) -> str:
    return str(error).removeprefix(f"{path}: ")


def _corners_or_refuse(picture: np.ndarray, board: Board) -> Float[np.ndarray, "N 2"]:
    found = find_corners(picture, board)
    if found is None:
        other = seen_board(picture)
        seen = "" if other is None else f", but one with {other[0]}x{other[1]}: check --board"
        raise CalibrationError(f"no board with {board[0]}x{board[1]} inner corners found{seen}")
    return found


def _refuse_other_size(picture: np.ndarray, size: tuple[int, int]) -> None:
    height, width = picture.shape
    if (width, height) != size:
        raise CalibrationError(
            f"{width}x{height} px, another size than the plane's picture ({size[0]}x{size[1]})"
        )


def _refuse_same_view(
    found: Float[np.ndarray, "N 2"], others: dict[Path, np.ndarray], *, diagonal_px: float
) -> None:
    for path, corners in others.items():
        if np.linalg.norm(found - corners, axis=1).max() < _SAME_VIEW * diagonal_px:
            raise CalibrationError(f"almost the same view as {path.name}")


def _require_views(corners: dict[Path, np.ndarray], left_out: list[LeftOut]) -> None:
    if len(corners) >= MIN_VIEWS:
        return
    shown = [f"{left.path.name}: {left.reason}" for left in left_out[:5]]
    if len(left_out) > 5:
        shown.append(f"and {len(left_out) - 5} more")
    why = f" ({'; '.join(shown)})" if shown else ""
    raise CalibrationError(
        f"expected at least {MIN_VIEWS} different pictures that show the whole board, the plane's "
        f"included, got {len(corners)}{why}; take more, {GOOD_VIEWS} to 20 are good, and check "
        "that --board counts inner corners"
    )


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


def _warnings(fit: LensFit) -> Iterator[str]:
    """What should be improved before the calibration is used."""
    width, height = fit.camera.width, fit.camera.height
    if len(fit.views) < GOOD_VIEWS:
        yield f"only {len(fit.views)} views; {GOOD_VIEWS} to 20 determine the lens better"
    limit = _GOOD_RMS * max(width, height)
    if fit.rms_px > limit:
        yield (
            f"the reprojection error of {fit.rms_px:.2f} px is above {limit:.2f} px; is the board "
            "flat, and are the pictures sharp?"
        )
    hull = cv2.convexHull(
        np.concatenate([view.corners_px for view in fit.views]).astype(np.float32)
    )
    coverage = cv2.contourArea(hull) / (width * height)
    if coverage < _GOOD_COVERAGE:
        yield (
            f"the boards cover {coverage:.0%} of the picture; distortion is extrapolated outside "
            "of them, so show the board near all edges too"
        )
    rim = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], np.float64)
    if np.abs(fit.camera.project(fit.camera.back_project(rim)) - rim).max() > 1.0:
        yield "the lens model folds over in the picture's corners; show the board near them too"
