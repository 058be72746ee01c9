"""The commands `calibrate` and `check`."""

import sys
from collections.abc import Iterator
from contextlib import closing
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stream_dmr.cli.shared_options import (
    BoardOption,
    MarkerOption,
    OverwriteOption,
    SquareOption,
    parse_ends,
    printable,
)
from stream_dmr.errors import OutputError, UserError

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from stream_dmr.calibration.board import BoardResult
    from stream_dmr.calibration.corners import PrintedBoard
    from stream_dmr.calibration.known_length import ScaleError
    from stream_dmr.calibration.lens import LensModel
    from stream_dmr.camera import Calibration


def calibrate(
    plane: Annotated[
        Path, "Photograph of the board in the reference plane; with --ends, of a ruler."
    ],
    images: Annotated[
        list[Path] | None,
        typer.Argument(help="Photographs of the board, tilted to all sides; none with --lens."),
    ] = None,
    board: BoardOption = "9x6",
    square_mm: SquareOption = 25.0,
    marker_mm: MarkerOption = None,
    model: Annotated[
        str,
        "pinhole, or fisheye for very wide lenses and domes; auto takes the fisheye if "
        "the pinhole fits badly and the fisheye does not.",
    ] = "auto",
    lens: Annotated[
        Path | None,
        "A calibration of this camera, also of another program: only the plane is "
        "measured, from --plane.",
    ] = None,
    camera: Annotated[str | None, "Which camera of --lens: left, right, cam0, ..."] = None,
    ends: Annotated[
        str | None,
        typer.Option(
            help="Without a board: both ends of a ruler in --plane, px, seen squarely.",
            metavar="U,V,U,V",
        ),
    ] = None,
    length_mm: Annotated[float | None, "Distance of the --ends in mm."] = None,
    focal_35mm: Annotated[
        float | None,
        "With --ends and no --lens: the focal length as on 35 mm film; phones have 24 to 28 mm.",
    ] = None,
    out: Annotated[Path, "Calibration file to write."] = Path("calibration.yaml"),
    corners: Annotated[
        Path | None, "Folder for pictures of the corners found; default: beside --out."
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Calibrate a camera and its reference plane from photographs of a board."""
    from stream_dmr.calibration.corners import PrintedBoard
    from stream_dmr.evidence.own_files import require_writable

    if model not in ("auto", "pinhole", "fisheye"):
        raise UserError(f"--model: expected auto, pinhole or fisheye, got {model}")
    if camera is not None and lens is None:
        raise UserError(
            f"--camera: expected with --lens alone, got {camera} without it; leave it out"
        )
    if lens is not None or ends is not None:
        for option, value in (("--model", model), ("--corners", corners)):
            if value not in ("auto", None):
                raise UserError(
                    f"{option}: expected with photographs alone, got {value} with "
                    f"{'--ends' if lens is None else '--lens'}; leave it out"
                )
    if ends is not None or length_mm is not None or focal_35mm is not None:
        if ends is None or length_mm is None or images or (lens is None) == (focal_35mm is None):
            raise UserError(
                "--ends: expected --length-mm and one of --focal-35mm and --lens with it, and no "
                "photographs of a board"
            )
        require_writable(out, overwrite=overwrite)
        _squarely(plane, parse_ends(ends), length_mm, lens, camera, focal_35mm, out)
        return
    if (lens is None) == (not images):
        raise UserError(
            "expected photographs of the board to calibrate the lens with, or --lens FILE with a "
            f"lens that is known, got {'neither' if lens is None else 'both'}"
        )
    require_writable(out, overwrite=overwrite)
    printed = PrintedBoard.parse(board, square_mm=square_mm, marker_mm=marker_mm)
    if lens is not None:
        _with_known_lens(lens, camera, plane=plane, board=printed, out=out)
        return
    _from_photographs(
        images or [],
        plane=plane,
        board=printed,
        model=model,
        out=out,
        folder=corners or out.with_name(f"{out.stem}-corners"),
        overwrite=overwrite,
    )


def _squarely(
    picture: Path,
    ends_px: "np.ndarray",
    length_mm: float,
    lens: Path | None,
    name: str | None,
    focal_35mm: float | None,
    out: Path,
) -> None:
    from stream_dmr.calibration.board import calibrate_squarely, camera_of_focal_35mm
    from stream_dmr.calibration.calibration_file import require_size, save_calibration
    from stream_dmr.calibration.corners import read_grey
    from stream_dmr.calibration.lens_file import load_lens

    height, width = read_grey(picture).shape
    if lens is not None:
        camera = load_lens(lens, name=name).camera((width, height))
    else:
        camera = camera_of_focal_35mm(focal_35mm or 0.0, width=width, height=height)
    calibration = calibrate_squarely(ends_px, length_mm, camera)
    require_size(calibration, width=width, height=height)
    save_calibration(out, calibration)
    distance_mm = calibration.plane.distance_mm
    print(f"lens: {camera.K[0, 0]:.0f} px of focal length, {width}x{height} px")
    print(
        f"reference plane {distance_mm:.0f} mm from the camera, taken to be seen squarely: "
        f"{distance_mm / camera.K[0, 0]:.4f} mm a pixel"
    )
    print(f"calibration: {out}")


def _with_known_lens(
    lens: Path, name: str | None, *, plane: Path, board: "PrintedBoard", out: Path
) -> None:
    from stream_dmr.calibration.board import calibrate_plane
    from stream_dmr.calibration.calibration_file import save_calibration
    from stream_dmr.calibration.lens_file import load_lens

    calibration, view = calibrate_plane(plane, load_lens(lens, name=name), board)
    save_calibration(out, calibration)
    camera = calibration.camera
    model = "fisheye" if camera.is_fisheye else "pinhole"
    print(
        f"{model} lens of {lens}, {camera.width}x{camera.height} px; board in {plane.name}: "
        f"{view.rms_px:.3f} px RMS, distances {view.distances.mean_percent:.2f} % off"
    )
    print(f"reference plane {view.plane.distance_mm:.0f} mm from the camera")
    print(f"calibration: {out}")


def _from_photographs(
    images: list[Path],
    *,
    plane: Path,
    board: "PrintedBoard",
    model: "LensModel",
    out: Path,
    folder: Path,
    overwrite: bool,
) -> None:
    from rich.console import Console
    from rich.progress import track

    from stream_dmr.calibration.board import calibrate as calibrate_camera
    from stream_dmr.calibration.board import draw_views
    from stream_dmr.calibration.calibration_file import save_calibration

    if folder.is_dir() and not overwrite and any(folder.iterdir()):
        raise OutputError(
            f"{folder}: expected an empty folder for the corners found, got one with files in it; "
            "choose another with --corners, or add --overwrite"
        )
    console = Console(file=sys.stdout, markup=False, emoji=False)  # names are shown as they are
    result = calibrate_camera(
        track(images, "Looking for the board", console=console, transient=True),
        plane_image=plane,
        board=board,
        model=model,
    )
    save_calibration(out, result.calibration)
    console.print(_views_table(result))
    for left in result.left_out:
        print(f"left out: {left.path.name}: {left.reason}")
    for line in _summary(result):
        print(line)
    print(f"calibration: {out}")
    draw_views(result, folder)
    print(f"corners drawn: {folder}")


def _views_table(result: "BoardResult") -> "Table":
    from rich.table import Table

    table = Table("picture", title="Reprojection error, and error of known distances on the board")
    for title in ("RMS px", "mean mm", "max mm", "mean %", "max %"):
        table.add_column(title, justify="right")
    for view in result.fit.views:
        errors = view.distances
        table.add_row(
            printable(view.path.name) + (" (plane)" if view is result.plane_view else ""),
            f"{view.rms_px:.3f}",
            f"{errors.mean_mm:.2f}",
            f"{errors.max_mm:.2f}",
            f"{errors.mean_percent:.2f}",
            f"{errors.max_percent:.2f}",
        )
    return table


def _summary(result: "BoardResult") -> list[str]:
    camera, fit = result.calibration.camera, result.fit
    distance_mm = result.calibration.plane.distance_mm
    focal = " and ".join(
        f"{camera.K[axis, axis]:.1f} ± {fit.focal_std_px[axis]:.1f} px" for axis in (0, 1)
    )
    return [
        *([result.model_note] if result.model_note else []),
        f"{len(fit.views)} views, reprojection error {fit.rms_px:.3f} px RMS",
        f"focal length {focal}; reference plane {distance_mm:.0f} mm from the camera",
        *(f"warning: {warning}" for warning in result.warnings),
    ]


_MAX_PICTURES = 100  # of a clip or a camera, in which the board is looked for; chosen


def check(
    source: Annotated[
        str, typer.Argument(help="A picture, a video, rtsp://... or a camera's index.")
    ],
    calibration: Annotated[Path, "The calibration that is checked."],
    board: BoardOption = "9x6",
    square_mm: SquareOption = 25.0,
    marker_mm: MarkerOption = None,
    ends: Annotated[
        str | None, typer.Option(help="Ends of a rod, px, instead of a board.", metavar="U,V,U,V")
    ] = None,
    length_mm: Annotated[float | None, "Length of the rod in mm."] = None,
    limit: Annotated[
        float, typer.Option(help="Per cent off that raise an alarm and exit code 1.", min=0)
    ] = 1.0,
    out: Annotated[Path | None, "Folder of a run; the check is kept in its lengths.db."] = None,
) -> None:
    """Measure a board, or a rod of known length, that lies in the reference plane.

    It is the one thing that sees a wrong scale. With --out it is kept with its time, and stands in
    every later export.
    """
    from stream_dmr.calibration.calibration_file import load_calibration
    from stream_dmr.calibration.corners import PrintedBoard
    from stream_dmr.files import sha256_of
    from stream_dmr.store.fish import database_of
    from stream_dmr.store.scale_checks import ScaleCheck, add_check

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
    from stream_dmr.sources.source import ReadFramesSettings

    if Path(source).suffix.lower() in PICTURE_SUFFIXES:
        yield read_grey(Path(source))
        return
    with closing(open_source(source, ReadFramesSettings(orientation="sensor"))) as frames:
        for frame in islice(frames, _MAX_PICTURES):
            yield cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
