"""`stream-dmr calibrate`: photographs of a chessboard in, a calibration file out."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stream_dmr.cli.shared_options import OverwriteOption

if TYPE_CHECKING:
    from rich.table import Table

    from stream_dmr.calibration.board import BoardResult


def calibrate(
    images: Annotated[
        list[Path], typer.Argument(help="Photographs of the board, tilted to all sides.")
    ],
    plane: Annotated[
        Path, typer.Option(help="Photograph of the board lying in the reference plane.")
    ],
    board: Annotated[
        str, typer.Option(help="Inner corners per row and column; 10x7 squares have 9x6.")
    ] = "9x6",
    square_mm: Annotated[float, typer.Option(help="Side of one square in mm.")] = 25.0,
    out: Annotated[Path, typer.Option(help="Calibration file to write.")] = Path(
        "calibration.yaml"
    ),
    corners: Annotated[
        Path | None,
        typer.Option(help="Folder for pictures of the corners found; default: beside --out."),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Calibrate a camera and its reference plane from photographs of a chessboard."""
    from rich.console import Console
    from rich.progress import track

    from stream_dmr.calibration.board import calibrate as calibrate_camera
    from stream_dmr.calibration.board import draw_views, parse_board
    from stream_dmr.calibration.calibration_file import save_calibration
    from stream_dmr.errors import OutputError
    from stream_dmr.results.own_files import require_writable

    require_writable(out, overwrite=overwrite)
    folder = corners or out.with_name(f"{out.stem}-corners")
    if folder.is_dir() and not overwrite and any(folder.iterdir()):
        raise OutputError(
            f"{folder}: expected an empty folder for the corners found, got one with files in it; "
            "choose another with --corners, or add --overwrite"
        )
    console = Console()
    result = calibrate_camera(
        track(images, "Looking for the board", console=console, transient=True),
        plane_image=plane,
        board=parse_board(board),
        square_mm=square_mm,
    )
    save_calibration(out, result.calibration)
    console.print(_views_table(result))
    for left in result.left_out:
        console.print(f"left out: {left.path.name}: {left.reason}", markup=False, soft_wrap=True)
    for line in _summary(result):
        console.print(line, markup=False, soft_wrap=True)
    console.print(f"calibration: {out}", markup=False, soft_wrap=True)
    draw_views(result, folder)
    console.print(f"corners drawn: {folder}", markup=False, soft_wrap=True)


def _views_table(result: "BoardResult") -> "Table":
    from rich.table import Table

    table = Table("picture", title="Reprojection error, and error of known distances on the board")
    for title in ("RMS px", "mean mm", "max mm", "mean %", "max %"):
        table.add_column(title, justify="right")
    for view in result.fit.views:
        errors = view.distances
        table.add_row(
            f"{view.path.name} (plane)" if view is result.plane_view else view.path.name,
            f"{view.rms_px:.3f}",
            f"{errors.mean_mm:.2f}",
            f"{errors.max_mm:.2f}",
            f"{errors.mean_percent:.2f}",
            f"{errors.max_percent:.2f}",
        )
    return table


def _summary(result: "BoardResult") -> list[str]:
    camera, fit = result.calibration.camera, result.fit
    plane = result.calibration.plane
    distance_mm = float(plane.rotation[:, 2] @ plane.translation_mm)
    focal = " and ".join(
        f"{camera.K[axis, axis]:.1f} ± {fit.focal_std_px[axis]:.1f} px" for axis in (0, 1)
    )
    return [
        f"{len(fit.views)} views, reprojection error {fit.rms_px:.3f} px RMS",
        f"focal length {focal}; reference plane {distance_mm:.0f} mm from the camera",
        *(f"warning: {warning}" for warning in result.warnings),
    ]
