"""Calibrate a camera from pictures of a board."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from stream_dmr.calibration.corners import BoardCorners, PrintedBoard, draw_corners, read_grey
from stream_dmr.calibration.known_length import require_ends
from stream_dmr.calibration.lens import (
    BoardView,
    LeftOut,
    LensFit,
    LensModel,
    choose_fit,
    quality_warnings,
    require_determined,
    require_views,
)
from stream_dmr.calibration.lens_file import LensFile
from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.errors import CalibrationError
from stream_dmr.files import make_folder, writing_to

_SAME_VIEW = 0.01  # of the picture's diagonal, chosen: closer boards add no information
# Of the picture's longer side; chosen: the lens of another camera is worse.
_GOOD_PLANE_RMS = 1 / 1000


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardResult:
    """The calibration and the figures to judge it by."""

    calibration: Calibration
    board: PrintedBoard
    fit: LensFit  # with the views and their reprojection errors
    plane_view: BoardView  # the view whose board lies in the reference plane
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]
    model_note: str  # why the lens is a fisheye; "" if nothing was chosen


def calibrate(
    image_paths: Iterable[Path | str],
    *,
    plane_image: Path | str,
    board: PrintedBoard | None = None,
    model: LensModel = "auto",
) -> BoardResult:
    """Calibrate the camera from all pictures, and the reference plane from `plane_image`.

    In `plane_image` the board lies in the reference plane; that picture serves for the lens as
    well, listed among `image_paths` or not. After Zhang, "A Flexible New Technique for Camera
    Calibration", PAMI 2000, as in OpenCV.

    Raises CalibrationError if the plane's picture is unusable, fewer than MIN_VIEWS pictures show
    the board, or the views are too much alike to determine the focal length.
    """
    plane_image, board = Path(plane_image), board or PrintedBoard()
    found, size, left_out = _find_boards(image_paths, plane_image, board)
    require_views(len(found), left_out)
    chosen = choose_fit(found, size, plane_image=plane_image, model=model)
    require_determined(chosen.fit)
    plane_view = next(view for view in chosen.fit.views if view.path == plane_image)
    return BoardResult(
        calibration=Calibration(camera=chosen.fit.camera, plane=plane_view.plane),
        board=board,
        fit=chosen.fit,
        plane_view=plane_view,
        left_out=(*left_out, *chosen.outliers),
        warnings=tuple(quality_warnings(chosen.fit)),
        model_note=chosen.note,
    )


def calibrate_plane(
    plane_image: Path | str, lens: LensFile, board: PrintedBoard
) -> tuple[Calibration, BoardView]:
    """The reference plane from one picture of a camera with a known lens.

    Raises CalibrationError if the picture is of another size, shows no board, or shows a board that
    does not fit this lens.
    """
    path = Path(plane_image)
    picture, corners = _plane_corners(path, board)
    camera = lens.camera((picture.shape[1], picture.shape[0]))
    try:
        _refuse_other_size(picture, (camera.width, camera.height), "the lens is for")
    except CalibrationError as error:
        raise CalibrationError(f"--plane {path}: {error}") from error
    view = BoardView.measured(path, corners, camera)
    limit = _GOOD_PLANE_RMS * max(camera.width, camera.height)
    if view.rms_px > limit:
        raise CalibrationError(
            f"--plane {path}: expected corners within {limit:.1f} px of what the lens says, got "
            f"{view.rms_px:.1f} px: is the lens another camera's, or the board bent? Else "
            "calibrate with pictures of this camera"
        )
    return Calibration(camera=camera, plane=view.plane), view


def draw_views(result: BoardResult, folder: Path) -> None:
    """Write a picture of each view with its corners drawn, for a check by eye.

    Raises OutputError if the folder can't be written to.
    """
    with writing_to(make_folder(folder)):
        for number, view in enumerate(result.fit.views, start=1):
            out = folder / f"{number:02d}_{view.path.stem}.png"  # two folders may share a name
            draw_corners(view.path, view.corners.pixels, result.board.inner, out)


def _find_boards(
    image_paths: Iterable[Path | str], plane_image: Path, board: PrintedBoard
) -> tuple[dict[Path, BoardCorners], tuple[int, int], list[LeftOut]]:
    """Corners by picture, the plane's first; their (width, height); the pictures left out."""
    picture, plane_corners = _plane_corners(plane_image, board)
    size = (picture.shape[1], picture.shape[0])
    corners, left_out, seen = {plane_image: plane_corners}, [], {plane_image.resolve()}
    for path in map(Path, image_paths):
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        try:
            picture = read_grey(path)
            _refuse_other_size(picture, size, "the plane's picture is")
            found = _corners_or_refuse(picture, board)
            for name, other in corners.items():
                here, there = found.shared_with(other)
                gaps_px = np.linalg.norm(here - there, axis=1)
                if len(here) and gaps_px.max() < _SAME_VIEW * np.hypot(*size):
                    raise CalibrationError(f"almost the same view as {name.name}")
            corners[path] = found
        except CalibrationError as error:
            left_out.append(LeftOut(path=path, reason=_reason(error, path)))
    return corners, size, left_out


def _plane_corners(
    plane_image: Path, board: PrintedBoard
) -> tuple[UInt8[np.ndarray, "H W"], BoardCorners]:
    try:
        picture = read_grey(plane_image)
        return picture, _corners_or_refuse(picture, board)
    except CalibrationError as error:
        raise CalibrationError(
            f"--plane {plane_image}: expected a picture of the board lying in the reference "
            f"plane, got: {_reason(error, plane_image)}; take that picture again"
        ) from error


def _reason(error: CalibrationError, path: Path) -> str:
    return str(error).removeprefix(f"{path}: ")


def _corners_or_refuse(picture: UInt8[np.ndarray, "H W"], board: PrintedBoard) -> BoardCorners:
    found = board.find(picture)
    if found is None:
        raise CalibrationError(board.not_found(picture))
    return found


def _refuse_other_size(
    picture: UInt8[np.ndarray, "H W"], size: tuple[int, int], other: str
) -> None:
    height, width = picture.shape
    if (width, height) != size:
        raise CalibrationError(f"{width}x{height} px, another size: {other} {size[0]}x{size[1]}")


_FILM_DIAGONAL_MM = 43.27  # of a picture on 35 mm film, 36 x 24 mm
_LEAST_FOCAL_MM, _LARGEST_FOCAL_MM = 8, 1000  # wider lenses are no pinholes


def camera_of_focal_35mm(focal_mm: float, *, width: int, height: int) -> Camera:
    """The pinhole of a focal length as on 35 mm film, by the picture's diagonal.

    Raises CalibrationError if no pinhole has it.
    """
    if not _LEAST_FOCAL_MM <= focal_mm <= _LARGEST_FOCAL_MM:
        raise CalibrationError(
            f"--focal-35mm: expected {_LEAST_FOCAL_MM} to {_LARGEST_FOCAL_MM} mm, got {focal_mm:g}"
        )
    focal_px = focal_mm / _FILM_DIAGONAL_MM * float(np.hypot(width, height))
    K = np.diag([focal_px, focal_px, 1.0])
    K[:2, 2] = (width - 1) / 2, (height - 1) / 2
    return Camera(width=width, height=height, K=K, distortion=np.zeros(5))


def calibrate_squarely(
    ends_px: Float[np.ndarray, "2 2"], length_mm: float, camera: Camera
) -> Calibration:
    """A plane at a right angle to the camera's axis on which two pixels are so far apart.

    Raises CalibrationError for ends that are no two points of the picture, or no length.
    """
    require_ends(ends_px, length_mm, camera)
    rays = camera.back_project(ends_px)  # at depth 1
    depth_mm = length_mm / float(np.linalg.norm(rays[1] - rays[0]))
    plane = ReferencePlane(rotation=np.eye(3), translation_mm=np.array([0.0, 0.0, depth_mm]))
    return Calibration(camera=camera, plane=plane)
