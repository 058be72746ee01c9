"""`stream-dmr verify`, `report` and `review`: what a reviewer does with results."""

from pathlib import Path
from typing import Annotated

import typer


def verify(
    folder: Annotated[Path, typer.Argument(help="The --out of runs or of exports.", metavar="DIR")],
) -> None:
    """Check that results are still what their run measured; exit 1 and say what was changed."""
    from stream_dmr.verify import verify as verify_results

    changes, num_files = verify_results(folder)
    for change in changes:
        print(f"{change.path}: {change.what}")
    if changes:
        raise typer.Exit(1)
    print(f"{folder}: {num_files} files, nothing was changed")
