"""`stream-dmr recover`: repairs what a crash or a power cut left unfinished."""

from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.shared_options import KeyOption


def recover(
    folder: Annotated[Path, typer.Argument(help="The folder of a run.", metavar="DIR")],
    key: KeyOption = None,
) -> None:
    """Repair recordings that a crash or a power cut left unfinished.

    `run` does it by itself when it starts. Lengths that a full disk kept out of lengths.db are
    taken over from the recordings. With --key what was repaired is signed as found after a crash.
    """
    from stream_dmr.running.recovery import recover_folder

    count = 0
    for line in recover_folder(folder, key=key):
        print(line)
        count += 1
    if not count:
        print(f"{folder}: nothing to repair")
