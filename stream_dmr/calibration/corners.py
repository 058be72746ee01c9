"""Finds the inner corners of a chessboard in a photograph, and draws them."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stream_dmr.errors import CalibrationError
from stream_dmr.pictures import read_picture, size_if_huge

Board = tuple[int, int]  # inner corners a row, and a column

# The board is searched in a copy of this size, so that large photographs take no longer than small
# ones; squares down to some 6 px of the copy are found.
_SEARCH_SIDE_PX = 1280
# Half the window of the sub-pixel search, in squares: as large as possible without including the
# next corners. On rendered views 0.15 had twice the error of 0.4, and ten times when blurred.
_WINDOW_SQUARES = 0.4
_MAX_WINDOW_PX = 30  # larger ones took longer and were not more accurate
_STOP_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
_DRAWN_SIDE_PX = 1600


def board_points_mm(board: Board, square_mm: float) -> Float[np.ndarray, "N 3"]:
    """Inner corners on the board's plane, Z = 0, row by row, in the order of `find_corners`."""
    rows, columns = np.mgrid[: board[1], : board[0]]
    points = np.stack([columns, rows, np.zeros_like(rows)], axis=-1)
    return points.reshape(-1, 3) * float(square_mm)


def read_grey(path: Path) -> UInt8[np.ndarray, "H W"]:
    """Read a picture in sensor orientation: grey, 8 bit, EXIF rotation ignored.

    Raises CalibrationError where the file can't be read, is no picture, or one that is too large.
    """
    if huge := size_if_huge(path):
        raise CalibrationError(f"{path}: too large: {huge}")
    try:
        picture = read_picture(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except OSError as error:
        raise CalibrationError(f"{path}: can't be read: {error.strerror}") from error
    if picture is None:
        raise CalibrationError(f"{path}: no picture, or a broken one")
    return np.asarray(picture, np.uint8)


def find_corners(
    picture: UInt8[np.ndarray, "H W"], board: Board
) -> Float[np.ndarray, "N 2"] | None:
    """Sub-pixel inner corners in px, row by row; None where no whole board is found.

    The sector-based detector (Duda and Frese, "Accurate Detection and Localization of Checkerboard
    Corners for Calibration", BMVC 2018) finds them in a small copy; `cornerSubPix` then refines
    them in the picture itself. The first corner is the one nearest the picture's top-left and the
    board's Z points away from the camera, in whichever order the detector returns them.
    """
    scale = max(1.0, max(picture.shape) / _SEARCH_SIDE_PX)
    found, corners = cv2.findChessboardCornersSB(
        _resized(picture, scale),
        board,
        flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE,
    )
    if not found:
        return None
    coarse = (corners.reshape(-1, 2).astype(np.float64) + 0.5) * scale - 0.5
    return _in_order(_refined(picture, coarse, board), board)


def seen_board(picture: UInt8[np.ndarray, "H W"]) -> Board | None:
    """The inner corners of whatever board is in a picture, the larger number first; None: none."""
    scale = max(1.0, max(picture.shape) / _SEARCH_SIDE_PX)
    found, _, meta = cv2.findChessboardCornersSBWithMeta(
        _resized(picture, scale),
        (3, 3),
        cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE,
    )
    if not found:
        return None
    rows, columns = meta.shape[:2]
    return max(rows, columns), min(rows, columns)


def draw_corners(path: Path, corners: Float[np.ndarray, "N 2"], board: Board, out: Path) -> None:
    """Write the picture at `path`, reduced if large, with its corners drawn, to `out`.

    Lines join them where all of the board's are there.
    """
    picture = read_grey(path)
    scale = max(1.0, max(picture.shape) / _DRAWN_SIDE_PX)
    canvas = cv2.cvtColor(_resized(picture, scale), cv2.COLOR_GRAY2BGR)
    drawn = ((corners + 0.5) / scale - 0.5).astype(np.float32).reshape(-1, 1, 2)
    cv2.drawChessboardCorners(canvas, board, drawn, len(drawn) == board[0] * board[1])
    _, encoded = cv2.imencode(".png", canvas)
    out.write_bytes(encoded.tobytes())


def _resized(picture: UInt8[np.ndarray, "H W"], scale: float) -> UInt8[np.ndarray, "h w"]:
    if scale == 1.0:
        return picture
    height, width = (round(side / scale) for side in picture.shape)
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def _refined(
    picture: UInt8[np.ndarray, "H W"], coarse: Float[np.ndarray, "N 2"], board: Board
) -> Float[np.ndarray, "N 2"]:
    grid = coarse.reshape(board[1], board[0], 2)
    square_px = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
    window = int(np.clip(_WINDOW_SQUARES * square_px, 2, _MAX_WINDOW_PX))
    start = coarse.astype(np.float32).reshape(-1, 1, 2)
    fine = cv2.cornerSubPix(picture, start.copy(), (window, window), (-1, -1), _STOP_CRITERIA)
    fine = fine.reshape(-1, 2).astype(np.float64)
    # A corner that moved by more than that converged to something else: keep the detector's.
    diverged = np.linalg.norm(fine - coarse, axis=1) > square_px / 3
    return np.where(diverged[:, None], coarse, fine)


def _in_order(corners: Float[np.ndarray, "N 2"], board: Board) -> Float[np.ndarray, "N 2"]:
    grid = corners.reshape(board[1], board[0], 2)
    (ax, ay), (bx, by) = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if ax * by < ay * bx:  # mirrored: Z would point at the camera
        grid = grid[:, ::-1]
    if grid[0, 0].sum() > grid[-1, -1].sum():
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid).reshape(-1, 2)
