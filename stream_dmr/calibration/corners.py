"""Find the inner corners of chessboards and ChArUco boards, and print such boards.

A ChArUco board is a chessboard with a marker in each white square that identifies its corners
(Garrido-Jurado et al., Pattern Recognition 2014; OpenCV's `CharucoDetector`), so a part in view is
enough. The markers' dictionary is found out, and whether the first square is black or white (OpenCV
4.6 changed that).
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from stream_dmr.errors import CalibrationError
from stream_dmr.pictures import read_picture, size_if_huge

Board = tuple[int, int]  # inner corners a row, and a column

# The board is searched in a copy of this size, so that large photographs take no longer than small
# photographs; squares down to some 6 px of the copy are found.
_SEARCH_SIDE_PX = 1280
# Half the window of the sub-pixel search, in squares: as large as possible without including the
# next corners. On rendered views 0.15 had twice the error of 0.4, and ten times when blurred.
_WINDOW_SQUARES = 0.4
_MAX_WINDOW_PX = 30  # larger windows took longer and were not more accurate
_STOP_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
_DRAWN_SIDE_PX = 1600


def read_grey(path: Path) -> UInt8[np.ndarray, "H W"]:
    """Read a picture in sensor orientation: grey, 8 bit, EXIF rotation ignored.

    Raises CalibrationError if the file can't be read, is no picture, or is too large.
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
    """Sub-pixel inner corners in px, row by row; None if no whole board is found.

    The sector-based detector (Duda and Frese, "Accurate Detection and Localization of Checkerboard
    Corners for Calibration", BMVC 2018) finds them in a small copy; `cornerSubPix` then refines
    them in the picture itself. The first corner is the one nearest the picture's top-left and the
    board's Z points away from the camera, in any order that the detector returns them.
    """
    scale = max(1.0, max(picture.shape) / _SEARCH_SIDE_PX)
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCornersSB(_resized(picture, scale), board, flags=flags)
    if not found:
        return None
    coarse = (corners.reshape(-1, 2).astype(np.float64) + 0.5) * scale - 0.5
    return _in_order(_refined(picture, coarse, board), board)


def seen_board(picture: UInt8[np.ndarray, "H W"]) -> Board | None:
    """The inner corners of whatever board is in a picture, the larger number first; None: none."""
    scale = max(1.0, max(picture.shape) / _SEARCH_SIDE_PX)
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    small = _resized(picture, scale)
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    return (max(meta.shape[:2]), min(meta.shape[:2])) if found else None


def draw_corners(path: Path, corners: Float[np.ndarray, "N 2"], board: Board, out: Path) -> None:
    """Write the picture at `path`, reduced if large, with its corners drawn, to `out`.

    Lines join them if all corners of the board are there.
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


Markers = tuple[Float[np.ndarray, "M 4 2"], Int[np.ndarray, "M"]]  # corners in px, and ids

# The largest of each size: the smaller dictionaries are its first markers.
_DICTIONARIES = (
    *(cv2.aruco.DICT_4X4_1000, cv2.aruco.DICT_5X5_1000, cv2.aruco.DICT_6X6_1000),
    *(cv2.aruco.DICT_7X7_1000, cv2.aruco.DICT_ARUCO_ORIGINAL),
    *(cv2.aruco.DICT_APRILTAG_36H11, cv2.aruco.DICT_ARUCO_MIP_36H12),
)
# Chosen: six corners in two rows or more fix the pose of a plane with something to spare.
_MIN_CORNERS, _MIN_MARKERS = 6, 3
_MAX_SQUARES = 30  # a side, of a board of unknown size
# Markers of the right board lie on its grid but for the lens: on a dome, at the picture's edge, a
# quarter of a square off a common homography; markers of another width lie squares off.
_MAX_OFF_SQUARES = 0.5


class CharucoFinder:
    """Finds one board in pictures, beginning with the markers that it saw last."""

    def __init__(self, inner: Board, *, marker_share: float) -> None:
        """`inner` counts inner corners, `marker_share` is the side of a marker in squares."""
        self._inner, self._marker_share = inner, marker_share
        self._dictionaries = [*_DICTIONARIES]

    def find(
        self, picture: UInt8[np.ndarray, "H W"]
    ) -> tuple[Float[np.ndarray, "N 2"], Int[np.ndarray, "N"]] | None:
        """Sub-pixel inner corners in px and their numbers, row by row; None if too few are seen."""
        squares = (self._inner[0] + 1, self._inner[1] + 1)
        for dictionary, markers in self._seen_markers(picture):
            board = _fitting_board(markers, [squares], dictionary, self._marker_share)
            if board is None:
                continue
            corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(picture)
            numbers = _numbers(ids)
            rows, columns = np.divmod(numbers, self._inner[0])
            if len(numbers) >= _MIN_CORNERS and np.ptp(rows) > 0 and np.ptp(columns) > 0:
                return np.asarray(corners, np.float64).reshape(-1, 2), numbers
        return None

    def seen_squares(self, picture: UInt8[np.ndarray, "H W"]) -> Board | None:
        """Squares a row and a column of whatever ChArUco board is in a picture; None: none.

        The rows are as many as the highest marker in view needs.
        """
        for dictionary, markers in self._seen_markers(picture):
            needed = 2 * (int(markers[1].max()) + 1)  # squares; every second square has a marker
            sizes = [(n, max(2, -(-needed // n))) for n in range(3, _MAX_SQUARES + 1)]
            board = _fitting_board(markers, sizes, dictionary, self._marker_share)
            if board is not None:
                columns, rows = board.getChessboardSize()
                return int(columns), int(rows)
        return None

    def _seen_markers(self, picture: UInt8[np.ndarray, "H W"]) -> Iterator[tuple[int, Markers]]:
        for dictionary in [*self._dictionaries]:
            detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary))
            corners, ids, _ = detector.detectMarkers(picture)
            numbers = _numbers(ids)
            if len(numbers) >= _MIN_MARKERS:
                self._dictionaries.sort(key=lambda other: other != dictionary)
                yield dictionary, (np.array(corners).reshape(-1, 4, 2), numbers)


def _fitting_board(
    markers: Markers, sizes: Sequence[Board], dictionary: int, marker_share: float
) -> cv2.aruco.CharucoBoard | None:
    """The board among those sizes on whose grid the markers lie best; None if on no grid."""
    known = cv2.aruco.getPredefinedDictionary(dictionary)
    best, least = None, _MAX_OFF_SQUARES
    for size in sizes:
        for is_legacy in (False, True):
            board = cv2.aruco.CharucoBoard(size, 1.0, marker_share, known)
            board.setLegacyPattern(is_legacy)
            off = _off_squares(markers, board)
            if off < least:
                best, least = board, off
    return best


def _off_squares(markers: Markers, board: cv2.aruco.CharucoBoard) -> float:
    """How far the markers lie off the board's grid, in squares, root mean square."""
    corners, ids = markers
    places = {int(number): k for k, number in enumerate(board.getIds())}
    if not all(int(number) in places for number in ids):
        return np.inf
    points = np.array(board.getObjPoints())[[places[int(number)] for number in ids], :, :2]
    seen, flat = corners.reshape(-1, 2), points.reshape(-1, 2).astype(np.float64)
    homography, _ = cv2.findHomography(seen, flat)
    if not np.all(np.isfinite(np.asarray(homography, np.float64))):  # None if there is none
        return np.inf
    mapped = cv2.perspectiveTransform(seen.reshape(-1, 1, 2).astype(np.float64), homography)
    return float(np.sqrt(np.mean(np.sum((mapped.reshape(-1, 2) - flat) ** 2, axis=1))))


def _numbers(ids: object) -> Int[np.ndarray, "N"]:
    """OpenCV's list of ids, which is None if nothing was found."""
    return np.zeros(0, np.int64) if ids is None else np.asarray(ids, np.int64).ravel()


_SQUARES_MM = (1.0, 1000.0)  # chosen: other values are in m, or a slip
_CHARUCO = "charuco:"


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardCorners:
    """The inner corners found in one picture: all of a chessboard's, some of a ChArUco's."""

    pixels: Float[np.ndarray, "N 2"]
    points_mm: Float[np.ndarray, "N 3"]  # the same corners on the board, Z = 0

    def shared_with(self, other: "BoardCorners") -> "tuple[np.ndarray, np.ndarray]":
        """Pixels (M, 2) here and there of the corners that both have."""
        same = (self.points_mm[:, None] == other.points_mm[None]).all(axis=-1)
        mine, others = np.nonzero(same)
        return self.pixels[mine], other.pixels[others]


@dataclass(frozen=True, kw_only=True)
class PrintedBoard:
    """A chessboard, or a ChArUco board, of which a part in view is enough."""

    inner: Board = (9, 6)  # inner corners a row, and a column
    square_mm: float = 25.0
    marker_mm: float | None = None  # side of a ChArUco board's markers; None: a chessboard

    def __post_init__(self) -> None:
        """Raise CalibrationError for a board that can't be."""
        if not _SQUARES_MM[0] <= self.square_mm <= _SQUARES_MM[1]:
            raise CalibrationError(
                "--square-mm: expected the side of one square in mm, from "
                f"{_SQUARES_MM[0]:g} to {_SQUARES_MM[1]:g}, got {self.square_mm:g}"
            )
        if self.marker_mm is not None and not 0 < self.marker_mm < self.square_mm:
            raise CalibrationError(
                f"--marker-mm: expected the side of a marker in mm, above 0 and below the "
                f"square's {self.square_mm:g}, got {self.marker_mm:g}"
            )

    @classmethod
    def parse(cls, text: str, *, square_mm: float, marker_mm: float | None) -> "PrintedBoard":
        """Read "9x6", inner corners of a chessboard, or "charuco:7x5", squares of a ChArUco board.

        Raises CalibrationError for anything else.
        """
        is_charuco = text.strip().lower().startswith(_CHARUCO)
        if is_charuco != (marker_mm is not None):
            raise CalibrationError(
                "--board, --marker-mm: expected --marker-mm with --board charuco:7x5, and only "
                f"there; got --board {text} {'without' if is_charuco else 'with'} it"
            )
        if not is_charuco:
            return cls(inner=parse_board(text), square_mm=square_mm)
        columns, rows = parse_board(text.strip()[len(_CHARUCO) :])
        return cls(inner=(columns - 1, rows - 1), square_mm=square_mm, marker_mm=marker_mm)

    @property
    def name(self) -> str:
        """The board as `--board` takes it."""
        if self.marker_mm is None:
            return "{}x{}".format(*self.inner)
        return _CHARUCO + "{}x{}".format(*(count + 1 for count in self.inner))

    @property
    def points_mm(self) -> Float[np.ndarray, "N 3"]:
        """All inner corners on the board's plane, Z = 0, in the order of `find_corners`."""
        rows, columns = np.mgrid[: self.inner[1], : self.inner[0]]
        points = np.stack([columns, rows, np.zeros_like(rows)], axis=-1)
        return points.reshape(-1, 3) * float(self.square_mm)

    def find(self, picture: UInt8[np.ndarray, "H W"]) -> BoardCorners | None:
        """The corners in a picture; None without the board, or enough of a ChArUco board."""
        if self.marker_mm is None:
            pixels = find_corners(picture, self.inner)
            return None if pixels is None else BoardCorners(pixels=pixels, points_mm=self.points_mm)
        found = self._charuco.find(picture)
        if found is None:
            return None
        pixels, ids = found
        return BoardCorners(pixels=pixels, points_mm=self.points_mm[ids])

    def not_found(self, picture: UInt8[np.ndarray, "H W"]) -> str:
        """The message for a picture without this board, with the size of another board in it."""
        if self.marker_mm is None:
            counted, other = "inner corners", seen_board(picture)
        else:
            counted, other = "squares", self._charuco.seen_squares(picture)
        seen = "" if other is None else f"; saw one of {other[0]}x{other[1]}: check --board"
        return f"no board of {self.name} ({counted}) found{seen}"

    @cached_property
    def _charuco(self) -> CharucoFinder:
        marker_mm = self.marker_mm or 0.0
        return CharucoFinder(self.inner, marker_share=marker_mm / self.square_mm)


def parse_board(text: str) -> Board:
    """Read "9x6" as 9 by 6. Raises CalibrationError for anything else."""
    match = re.fullmatch(r"\s*(\d+)\s*[xX]\s*(\d+)\s*", text)
    board = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(board) < 3 or max(board) > 100:
        raise CalibrationError(
            f"--board: expected the numbers of inner corners a row and a column, 3 or more each, "
            f"such as 9x6 for a board of 10x7 squares, or charuco:7x5 for a ChArUco board of 7x5 "
            f"squares; got {text!r}"
        )
    return board
