"""Repair recordings that a crash left open."""

import errno
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.records import Message as McapMessage

from stream_dmr.errors import RecordingError
from stream_dmr.files import TransactionalFile, free_bytes, free_name, rename_durably, sync_path
from stream_dmr.recording.mcap.mcap_recording import McapRecording, is_torn, whole_records
from stream_dmr.recording.mcap.mcap_sink import PART, new_writer
from stream_dmr.recording.recorder import STEM
from stream_dmr.recording.rerun.rrd_file import copy_readable_chunks, is_closed
from stream_dmr.recording.topics import RECOVERED, RUN
from stream_dmr.version import __version__

REWRITTEN = ".rewritten"  # suffix of a copy that is being written
Edit = Callable[[str, bytes], bytes | None]
"""Topic and encoded message -> the message to write, or None to leave it out."""


def rewrite(path: Path, *, note: str, edit: Edit = lambda topic, data: data) -> tuple[Path, int]:
    """Copy the intact records of a file into a file beside it, durably.

    A metadata record named `note` marks the copy. Returns its path and its number of messages.
    Raises OSError if the disk refuses it.
    """
    copy = path.with_name(path.name + REWRITTEN)
    try:
        with closing(TransactionalFile(copy)) as file:
            num_messages = _copy(whole_records(path), file, note, edit)
            file.sync()
    except BaseException:
        copy.unlink(missing_ok=True)
        raise
    return copy, num_messages


def _copy(records: Iterable[object], file: TransactionalFile, note: str, edit: Edit) -> int:
    """Copy everything but the index, which the writer makes; returns the number of messages."""
    writer, num_messages = new_writer(file), 0
    schemas, channels, topics = {0: 0}, dict[int, int](), dict[int, str]()
    for record in records:
        match record:
            case Metadata(name=name, metadata=metadata):
                writer.add_metadata(name, metadata)
                if name == RUN:
                    writer.add_metadata(note, {"by": __version__})
            case Attachment() as a:
                writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
            case Schema(id=id_, name=name, encoding=encoding, data=data):
                schemas[id_] = writer.register_schema(name, encoding, data)
            case Channel(id=id_, topic=topic, message_encoding=encoding, schema_id=schema):
                topics[id_] = topic
                channels[id_] = writer.register_channel(topic, encoding, schemas[schema])
            case McapMessage() as m:
                data = edit(topics[m.channel_id], m.data)
                if data is not None:
                    channel = channels[m.channel_id]
                    writer.add_message(channel, m.log_time, data, m.publish_time, m.sequence)
                    num_messages += 1
            case _:
                pass
    writer.finish()
    return num_messages


DAMAGED = ".damaged"  # suffix of a file in which nothing is intact


class Repair(NamedTuple):
    """The repair of an unfinished file of a recording."""

    path: Path  # of the repaired file, or of a damaged file that was set aside
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
    """Repair one unfinished file; if the disk refuses that, it stays as it is."""
    try:
        found, outcome = _repair_rrd(path) if path.suffix == ".rrd" else _repair_mcap(path)
    except RecordingError:
        found, outcome = _set_aside_damaged(path)
    except OSError as error:
        found, outcome = path, f"it can't be repaired: {error.strerror}; it stays as it is"
    return Repair(found, f"{path.name}: left unfinished by {left_by}; {outcome}")


def _set_aside_damaged(path: Path) -> tuple[Path, str]:
    aside = path.with_name(path.name + DAMAGED)
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
    if free_bytes(rrd.parent) < rrd.stat().st_size:  # Rerun does not report a copy without room
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    copy_readable_chunks(rrd, repaired)
    if not (repaired.is_file() and is_closed(repaired)):
        raise RecordingError(f"{rrd}: nothing of it could be read")
    sync_path(repaired)
    rename_durably(repaired, rrd)
    return rrd, "what is whole of the view is kept"
