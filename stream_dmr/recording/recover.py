"""Repairs what a crash or a power cut left of recordings."""

import subprocess
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.writer import Writer

from stream_dmr import __version__
from stream_dmr.errors import RecordingError
from stream_dmr.recording.files import STEM
from stream_dmr.recording.mcap_file import McapFile, whole_records
from stream_dmr.recording.mcap_sink import PART, new_writer
from stream_dmr.recording.rerun_program import rerun_program
from stream_dmr.recording.rrd_file import is_closed
from stream_dmr.recording.topics import RECOVERED, RUN
from stream_dmr.recording.whole_file import WholeFile, rename_durably, sync_path

_REPAIRED, _DAMAGED = ".repaired", ".damaged"


class Repair(NamedTuple):
    """What was done about a recording that a crash left unfinished."""

    path: Path  # of what is whole of it, if anything is
    line: str  # for the user


def recover(folder: Path) -> Iterator[Repair]:
    """Make every recording in a folder whole, for any reader, in the order of their names.

    Nothing may be writing there. Each file is repaired beside itself and replaced at once, so a
    crash in the middle of it does no harm.
    """
    for leftover in folder.glob(f"{STEM}*{_REPAIRED}"):
        leftover.unlink()
    for part in sorted(folder.glob(f"{STEM}*.mcap{PART}")):
        yield _attempt(part, _repair_mcap)
    for rrd in sorted(folder.glob(f"{STEM}*.rrd")):
        if not is_closed(rrd):
            yield _attempt(rrd, _repair_rrd)


def _attempt(path: Path, repair: Callable[[Path], tuple[Path, str]]) -> Repair:
    try:
        found, done = repair(path)
    except RecordingError:
        found = path.with_name(path.name + _DAMAGED)
        path.replace(found)
        done = f"nothing in it is whole, it is kept as {found.name}"
    except OSError as error:
        found, done = path, f"it can't be repaired: {error.strerror}; it stays as it is"
    return Repair(found, f"{path.name}: left unfinished by a crash; {done}")


def _repair_mcap(part: Path) -> tuple[Path, str]:
    target = _free_name(part.with_name(part.name.removesuffix(PART)))
    if not McapFile(part).is_torn:  # the crash came before it got its name
        rename_durably(part, target)
        return target, f"it was complete and is {target.name} now"
    repaired = part.with_name(part.name + _REPAIRED)
    with closing(WholeFile(repaired)) as file:
        num_messages = _copy(whole_records(part), new_writer(file))
        file.sync()
    rename_durably(repaired, target)
    part.unlink()
    return target, f"its {num_messages} whole messages are in {target.name}"


def _copy(records: Iterable[object], writer: Writer) -> int:
    """Everything but the index, which the writer makes; the number of messages."""
    schemas, channels, num_messages = {0: 0}, dict[int, int](), 0
    for record in records:
        match record:
            case Metadata(name=name, metadata=metadata):
                writer.add_metadata(name, metadata)
                if name == RUN:
                    writer.add_metadata(RECOVERED, {"by": __version__})
            case Attachment() as a:
                writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
            case Schema(id=id_, name=name, encoding=encoding, data=data):
                schemas[id_] = writer.register_schema(name, encoding, data)
            case Channel(id=id_, topic=topic, message_encoding=encoding, schema_id=schema):
                channels[id_] = writer.register_channel(topic, encoding, schemas[schema])
            case McapMessage() as m:
                channel = channels[m.channel_id]
                writer.add_message(channel, m.log_time, m.data, m.publish_time, m.sequence)
                num_messages += 1
            case _:
                pass
    writer.finish()
    return num_messages


def _repair_rrd(rrd: Path) -> tuple[Path, str]:
    repaired = rrd.with_name(rrd.name + _REPAIRED)
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
