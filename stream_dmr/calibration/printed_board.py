"""The board that is photographed: its size, and where its corners are seen in a picture."""

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from stream_dmr.calibration.charuco import CharucoFinder
from stream_dmr.calibration.corners import Board, board_points_mm, find_corners, seen_board
from stream_dmr.errors import CalibrationError

_SQUARES_MM = (1.0, 1000.0)  # chosen: what is outside of them is in m, or a slip
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
        """Read "9x6", inner corners of a chessboard, or "charuco:7x5", squares as those are named.

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
        """As `--board` takes it."""
        if self.marker_mm is None:
            return "{}x{}".format(*self.inner)
        return _CHARUCO + "{}x{}".format(*(count + 1 for count in self.inner))

    @property
    def points_mm(self) -> Float[np.ndarray, "N 3"]:
        """All inner corners on the board's plane, row by row."""
        return board_points_mm(self.inner, self.square_mm)

    def find(self, picture: UInt8[np.ndarray, "H W"]) -> BoardCorners | None:
        """The corners in a picture; None where the board, or enough of a ChArUco board, is not."""
        if self.marker_mm is None:
            pixels = find_corners(picture, self.inner)
            return None if pixels is None else BoardCorners(pixels=pixels, points_mm=self.points_mm)
        found = self._charuco.find(picture)
        if found is None:
            return None
        pixels, ids = found
        return BoardCorners(pixels=pixels, points_mm=self.points_mm[ids])

    def not_found(self, picture: UInt8[np.ndarray, "H W"]) -> str:
        """What to say of a picture without this board: with another one's size, if it shows one."""
        what = f"no board of {self.name} ({self._counted}) found"
        if self.marker_mm is None:
            other = seen_board(picture)
        else:
            other = self._charuco.seen_squares(picture)
        seen = "" if other is None else f"; saw one of {other[0]}x{other[1]}: check --board"
        return what + seen

    @cached_property
    def _charuco(self) -> CharucoFinder:
        marker_mm = self.marker_mm or 0.0
        return CharucoFinder(self.inner, marker_share=marker_mm / self.square_mm)

    @property
    def _counted(self) -> str:
        return "inner corners" if self.marker_mm is None else "squares"


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
