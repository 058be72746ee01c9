"""`stream-dmr check`: a known length in the reference plane, measured."""

from collections.abc import Iterator
from contextlib import closing
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stream_dmr.cli.shared_options import BoardOption, MarkerOption, SquareOption, parse_ends
from stream_dmr.errors import OutputError, UserError

if TYPE_CHECKING:
    import numpy as np

    from stream_dmr.calibration.known_length import ScaleError
    from stream_dmr.calibration.printed_board import PrintedBoard
    from stream_dmr.camera import Calibration

_MAX_PICTURES = 100  # of a clip or a camera, in which the board is looked for; chosen


def check(
    source: Annotated[
        str, typer.Argument(help="A picture, a video, rtsp://... or a camera's index.")
    ],
    calibration: Annotated[Path, typer.Option(help="The calibration that is checked.")],
    board: BoardOption = "9x6",
    square_mm: SquareOption = 25.0,
    marker_mm: MarkerOption = None,
    ends: Annotated[
        str | None,
        typer.Option(help="Ends of a rod, px, instead of a board.", metavar="U,V,U,V"),
    ] = None,
    length_mm: Annotated[float | None, typer.Option(help="Length of the rod in mm.")] = None,
    limit: Annotated[
        float, typer.Option(help="Per cent off that raise an alarm and exit code 1.", min=0)
    ] = 1.0,
    out: Annotated[
        Path | None, typer.Option(help="Folder of a run; the check is kept in its lengths.db.")
    ] = None,
) -> None:
    """Measure a board, or a rod of known length, that lies in the reference plane.

    It is the one thing that sees a wrong scale. With --out it is kept with its time, and stands in
    every later export.
    """
    from stream_dmr.calibration.calibration_file import load_calibration
    from stream_dmr.calibration.printed_board import PrintedBoard
    from stream_dmr.files import sha256_of
    from stream_dmr.results.finished_fish import database_of
    from stream_dmr.results.scale_checks import ScaleCheck, add_check

    database = None if out is None else database_of(out)
    if out is not None and database is None:
        raise OutputError(f"--out {out}: expected the folder of a run, found no lengths.db in it")
    found = _measure(
        source,
        load_calibration(calibration),
        board=PrintedBoard.parse(board, square_mm=square_mm, marker_mm=marker_mm),
        ends=ends,
        length_mm=length_mm,
    )
    made = ScaleCheck(
        source=source,
        calibration_sha256=sha256_of(calibration),
        known_mm=found.known_mm,
        error_mm=found.error_mm,
        error_percent=found.error_percent,
        worst_percent=found.worst_percent,
        limit_percent=limit,
    )
    print(
        f"{found.known_mm:.1f} mm measured as {found.known_mm + found.error_mm:.1f} mm "
        f"({found.error_mm:+.2f} mm); scale {found.error_percent:+.2f} %, worst distance "
        f"{found.worst_percent:.2f} %"
    )
    if database is not None:
        add_check(database, made)
        print(f"kept in {database}")
    if made.alarm:
        print(f"alarm: {made.alarm}")
        raise typer.Exit(1)


def _measure(
    source: str,
    calibration: "Calibration",
    *,
    board: "PrintedBoard",
    ends: str | None,
    length_mm: float | None,
) -> "ScaleError":
    from stream_dmr.calibration.calibration_file import require_size
    from stream_dmr.calibration.known_length import scale_of_board, scale_of_ends

    if (ends is None) != (length_mm is None):
        raise UserError("--ends and --length-mm belong together: give both or neither")
    pictures = _pictures(source)
    first = next(pictures)
    require_size(calibration, width=first.shape[1], height=first.shape[0])
    if ends is None or length_mm is None:
        return scale_of_board(chain([first], pictures), calibration, board)
    return scale_of_ends(parse_ends(ends), length_mm, calibration)


def _pictures(source: str) -> Iterator["np.ndarray"]:
    """Grey pictures of a file, a video or a camera, in sensor orientation."""
    import cv2

    from stream_dmr.calibration.corners import read_grey
    from stream_dmr.pictures import PICTURE_SUFFIXES
    from stream_dmr.sources.open_source import open_source
    from stream_dmr.sources.read_settings import ReadFramesSettings

    if Path(source).suffix.lower() in PICTURE_SUFFIXES:
        yield read_grey(Path(source))
        return
    with closing(open_source(source, ReadFramesSettings(orientation="sensor"))) as frames:
        for frame in islice(frames, _MAX_PICTURES):
            yield cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
