"""Repairs what a crash or a power cut left of recordings."""

import subprocess
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import NamedTuple

from stream_dmr.errors import RecordingError
from stream_dmr.files import rename_durably, sync_path
from stream_dmr.recording.files import STEM
from stream_dmr.recording.mcap.file import McapFile, is_torn
from stream_dmr.recording.mcap.sink import PART
from stream_dmr.recording.messages.topics import RECOVERED
from stream_dmr.recording.reading.rewrite import REWRITTEN, rewrite
from stream_dmr.recording.rerun.file import is_closed
from stream_dmr.recording.rerun.program import rerun_program

_DAMAGED = ".damaged"  # after the name of a file of which nothing is whole


class Repair(NamedTuple):
    """What was done about a recording that a crash left unfinished."""

    path: Path  # of what is whole of it, if anything is
    line: str  # for the user


def recover(folder: Path) -> Iterator[Repair]:
    """Make every recording in a folder whole, for any reader, in the order of their names.

    Nothing may be writing there. Each file is repaired beside itself and replaced at once, so a
    crash in the middle of it does no harm.
    """
    for leftover in folder.glob(f"{STEM}*{REWRITTEN}"):
        with suppress(OSError):
            leftover.unlink()
    unfinished = [*sorted(folder.glob(f"{STEM}*.mcap{PART}")), *sorted(folder.glob(f"{STEM}*.rrd"))]
    for path in unfinished:
        if is_unfinished(path):
            yield repair(path)


def is_unfinished(path: Path) -> bool:
    """Whether this is a file of a recording that was not closed; nothing may be writing it."""
    is_view = path.suffix == ".rrd"
    return path.exists() and (not is_closed(path) if is_view else path.suffix == PART)


def repair(path: Path, *, left_by: str = "a crash") -> Repair:
    """Make one file of a recording whole; where the disk refuses that, it stays as it is."""
    try:
        found, done = _repair_rrd(path) if path.suffix == ".rrd" else _repair_mcap(path)
    except RecordingError:
        found, done = _set_aside(path)
    except OSError as error:
        found, done = path, f"it can't be repaired: {error.strerror}; it stays as it is"
    return Repair(found, f"{path.name}: left unfinished by {left_by}; {done}")


def _set_aside(path: Path) -> tuple[Path, str]:
    aside = path.with_name(path.name + _DAMAGED)
    try:
        path.replace(aside)
    except OSError as error:
        return path, f"nothing in it is whole, and it stays as it is: {error.strerror}"
    return aside, f"nothing in it is whole, it is kept as {aside.name}"


def _repair_mcap(part: Path) -> tuple[Path, str]:
    target = _free_name(part.with_name(part.name.removesuffix(PART)))
    if not is_torn(part):  # the crash came before it got its name
        rename_durably(part, target)
        return target, f"it was complete and is {target.name} now"
    repaired, num_messages = rewrite(part, note=RECOVERED)
    try:
        McapFile(repaired)
    except RecordingError:
        repaired.unlink()
        raise
    rename_durably(repaired, target)
    part.unlink()
    return target, f"its {num_messages} whole messages are in {target.name}"


def _repair_rrd(rrd: Path) -> tuple[Path, str]:
    repaired = rrd.with_name(rrd.name + REWRITTEN)
    command = [
        rerun_program(),
        "rrd",
        "filter",
        "--continue-on-error",
        str(rrd),
        "-o",
        str(repaired),
    ]
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if not (repaired.is_file() and is_closed(repaired)):
        raise RecordingError(f"{rrd}: nothing of it could be read")
    sync_path(repaired)
    rename_durably(repaired, rrd)
    return rrd, "what is whole of the view is kept"


def _free_name(path: Path) -> Path:
    names = (path.with_stem(f"{path.stem}-{number}") for number in count(1))
    return path if not path.exists() else next(name for name in names if not name.exists())
