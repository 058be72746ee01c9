"""Repairs recordings that a crash, a power cut or a full disk left unfinished."""

import errno
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from stream_dmr.errors import RecordingError
from stream_dmr.files import free_bytes, free_name, rename_durably, sync_path
from stream_dmr.recording.mcap.mcap_recording import McapRecording, is_torn
from stream_dmr.recording.mcap.mcap_sink import PART
from stream_dmr.recording.mcap.rewrite import REWRITTEN, rewrite
from stream_dmr.recording.messages.topics import RECOVERED
from stream_dmr.recording.rerun.rerun_program import copy_readable_chunks
from stream_dmr.recording.rerun.rrd_recording import is_closed
from stream_dmr.recording.segments.recording_files import STEM

_DAMAGED = ".damaged"  # suffix of a file in which nothing is intact


class Repair(NamedTuple):
    """What was done about an unfinished file of a recording."""

    path: Path  # of the repaired file, or of the one that was set aside
    line: str  # for the user


def repair_recordings(folder: Path) -> Iterator[Repair]:
    """Repair every unfinished recording in a folder, in the order of their names.

    Nothing may be writing there. Each file is repaired beside itself and then replaced in one step,
    so that a crash during the repair does no harm.
    """
    for leftover in folder.glob(f"{STEM}*{REWRITTEN}"):
        with suppress(OSError):
            leftover.unlink()
    for pattern in (f"{STEM}*.mcap{PART}", f"{STEM}*.rrd"):
        for path in sorted(folder.glob(pattern)):
            if is_unfinished(path):
                yield repair_file(path)


def is_unfinished(path: Path) -> bool:
    """True for a file of a recording that was not closed; nothing may be writing it."""
    is_view = path.suffix == ".rrd"
    return path.exists() and (not is_closed(path) if is_view else path.suffix == PART)


def repair_file(path: Path, *, left_by: str = "a crash") -> Repair:
    """Repair one unfinished file; where the disk refuses that, it stays as it is."""
    try:
        found, outcome = _repair_rrd(path) if path.suffix == ".rrd" else _repair_mcap(path)
    except RecordingError:
        found, outcome = _set_aside_damaged(path)
    except OSError as error:
        found, outcome = path, f"it can't be repaired: {error.strerror}; it stays as it is"
    return Repair(found, f"{path.name}: left unfinished by {left_by}; {outcome}")


def _set_aside_damaged(path: Path) -> tuple[Path, str]:
    aside = path.with_name(path.name + _DAMAGED)
    try:
        path.replace(aside)
    except OSError as error:
        return path, f"nothing in it is whole, and it stays as it is: {error.strerror}"
    return aside, f"nothing in it is whole, it is kept as {aside.name}"


def _repair_mcap(part: Path) -> tuple[Path, str]:
    target = free_name(part.with_name(part.name.removesuffix(PART)))
    if not is_torn(part):  # the crash came between its end and its renaming
        rename_durably(part, target)
        return target, f"it was complete and is {target.name} now"
    repaired, num_messages = rewrite(part, note=RECOVERED)
    try:
        McapRecording(repaired)
    except RecordingError:
        repaired.unlink()
        raise
    rename_durably(repaired, target)
    part.unlink()
    return target, f"its {num_messages} whole messages are in {target.name}"


def _repair_rrd(rrd: Path) -> tuple[Path, str]:
    repaired = rrd.with_name(rrd.name + REWRITTEN)
    if free_bytes(rrd.parent) < rrd.stat().st_size:  # Rerun does not say that the copy had no room
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    copy_readable_chunks(rrd, repaired)
    if not (repaired.is_file() and is_closed(repaired)):
        raise RecordingError(f"{rrd}: nothing of it could be read")
    sync_path(repaired)
    rename_durably(repaired, rrd)
    return rrd, "what is whole of the view is kept"
