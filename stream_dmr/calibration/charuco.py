"""Finds the inner corners of a ChArUco board, of which a part in view is enough.

A chessboard with a marker in each white square: the markers say which corner is which (Garrido-
Jurado et al., Pattern Recognition 2014; OpenCV's `CharucoDetector`). Which dictionary the markers
are of, and whether the first square is black or white (OpenCV 4.6 turned that round), is found out.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from stream_dmr.calibration.corners import Board

Markers = tuple[Float[np.ndarray, "M 4 2"], Int[np.ndarray, "M"]]  # corners in px, and ids

# The largest of each size: the smaller ones are its first markers.
_DICTIONARIES = (
    *(cv2.aruco.DICT_4X4_1000, cv2.aruco.DICT_5X5_1000, cv2.aruco.DICT_6X6_1000),
    *(cv2.aruco.DICT_7X7_1000, cv2.aruco.DICT_ARUCO_ORIGINAL),
    *(cv2.aruco.DICT_APRILTAG_36H11, cv2.aruco.DICT_ARUCO_MIP_36H12),
)
# Chosen: six corners in two rows or more fix the pose of a plane with something to spare.
_MIN_CORNERS, _MIN_MARKERS = 6, 3
_MAX_SQUARES = 30  # a side, of a board that is only recognised
# Markers of the right board lie on its grid but for the lens: on a dome, at the picture's edge, a
# quarter of a square off a common homography; those of another width lie squares off.
_MAX_OFF_SQUARES = 0.5


class CharucoFinder:
    """Finds one board in pictures; it looks first for the markers that it saw last."""

    def __init__(self, inner: Board, *, marker_share: float) -> None:
        """`inner` counts inner corners, `marker_share` is the side of a marker in squares."""
        self._inner, self._marker_share = inner, marker_share
        self._dictionaries = [*_DICTIONARIES]

    def find(
        self, picture: UInt8[np.ndarray, "H W"]
    ) -> tuple[Float[np.ndarray, "N 2"], Int[np.ndarray, "N"]] | None:
        """Sub-pixel inner corners in px and their numbers, row by row; None where too few are."""
        squares = (self._inner[0] + 1, self._inner[1] + 1)
        for dictionary, markers in self._seen_markers(picture):
            board = _fitting_board(markers, [squares], dictionary, self._marker_share)
            if board is None:
                continue
            corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(picture)
            numbers = _numbers(ids)
            if _spans_a_plane(numbers, self._inner):
                return np.asarray(corners, np.float64).reshape(-1, 2), numbers
        return None

    def seen_squares(self, picture: UInt8[np.ndarray, "H W"]) -> Board | None:
        """Squares a row and a column of whatever ChArUco board is in a picture; None: none.

        The rows are as many as the highest marker in view needs.
        """
        for dictionary, markers in self._seen_markers(picture):
            _, ids = markers
            sizes = [
                (columns, max(2, -(-2 * (int(ids.max()) + 1) // columns)))
                for columns in range(3, _MAX_SQUARES + 1)
            ]
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
    """The board among those sizes on whose grid the markers lie best; None: on none."""
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
    if not np.all(np.isfinite(np.asarray(homography, np.float64))):  # None where there is none
        return np.inf
    mapped = cv2.perspectiveTransform(seen.reshape(-1, 1, 2).astype(np.float64), homography)
    return float(np.sqrt(np.mean(np.sum((mapped.reshape(-1, 2) - flat) ** 2, axis=1))))


def _numbers(ids: object) -> Int[np.ndarray, "N"]:
    """OpenCV's list of ids, which is None where nothing was found."""
    return np.zeros(0, np.int64) if ids is None else np.asarray(ids, np.int64).ravel()


def _spans_a_plane(ids: Int[np.ndarray, "N"], inner: Board) -> bool:
    rows, columns = np.divmod(ids, inner[0])
    return len(ids) >= _MIN_CORNERS and bool(np.ptp(rows) > 0 and np.ptp(columns) > 0)
