"""`stream-dmr recover`: repairs what a crash or a power cut left unfinished."""

from pathlib import Path
from typing import Annotated

import typer


def recover(
    folder: Annotated[Path, typer.Argument(help="The folder of a run.", metavar="DIR")],
) -> None:
    """Repair recordings that a crash or a power cut left unfinished.

    `run` does it by itself when it starts. Lengths that a full disk kept out of lengths.db are
    taken over from the recordings.
    """
    from stream_dmr.running.recovery import recover_folder

    count = 0
    for line in recover_folder(folder):
        print(line)
        count += 1
    if not count:
        print(f"{folder}: nothing to repair")
