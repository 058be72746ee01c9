"""Keeps commands from replacing files of others, and the results of a run in any case."""

import re
from collections.abc import Callable
from pathlib import Path

from stream_dmr.errors import OutputError
from stream_dmr.evidence.seal import known_files, read_origin
from stream_dmr.files import open_file
from stream_dmr.store.schema import NAME as DATABASE

_OF_RUN = re.compile(
    r"lengths\.(db(-\w+)?|csv|reserve)|frames(-\d+)?\.csv|provenance\.json|recording.*\.mcap.*"
    r"|template(-\d+)?\.(ply|toml)"
)
_HEAD_BYTES = 4096  # in which a page or picture of ours names the command that made it


def require_writable(
    *paths: Path, overwrite: bool = False, is_own: Callable[[Path], bool] = lambda path: False
) -> None:
    """Raise OutputError if a command must not write to one of `paths`.

    An existing file needs `overwrite`, unless the command made it (`is_own`); measurements of a run
    are never overwritten, also not through a link.
    """
    for path in paths:
        if is_of_run(path.resolve()):
            raise OutputError(
                f"{path}: expected a file of another name, got one that a run wrote its results "
                "to; choose another"
            )
        if path.exists() and not overwrite and not is_own(path):
            raise OutputError(
                f"{path}: expected a name that is free, it is taken; choose another, or add "
                "--overwrite"
            )


def is_of_run(path: Path) -> bool:
    """True for the name of a file that a run writes into its folder.

    An .rrd is one if the run's provenance lists it, also after somebody removed it, or if there is
    no .mcap of the same content.
    """
    folder = path.parent
    if not (folder / DATABASE).exists() and read_origin(folder) != folder:
        return False
    if path.suffix == ".rrd":
        is_alone = path.exists() and not path.with_suffix(".mcap").exists()
        return path.name in known_files(folder) or is_alone
    return has_run_name(path)


def has_run_name(path: Path) -> bool:
    """True for a name that runs use for their files, in any folder."""
    return bool(_OF_RUN.fullmatch(path.name))


def is_made_by(command: str) -> Callable[[Path], bool]:
    """A test for files that name `stream-dmr COMMAND` in their first bytes."""

    def is_made(path: Path) -> bool:
        try:
            with open_file(path) as file:
                return f"stream-dmr {command}".encode() in file.read(_HEAD_BYTES)
        except OSError:
            return False

    return is_made
