"""Copies an .mcap record by record into a complete file, which any reader opens."""

from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.records import Message as McapMessage

from stream_dmr.files import TransactionalFile
from stream_dmr.recording.mcap.mcap_recording import whole_records
from stream_dmr.recording.mcap.mcap_sink import new_writer
from stream_dmr.recording.messages.topics import RUN
from stream_dmr.version import __version__

REWRITTEN = ".rewritten"  # suffix of a copy that is being written
Edit = Callable[[str, bytes], bytes | None]
"""Topic and encoded message -> the message to write, or None to leave it out."""


def rewrite(path: Path, *, note: str, edit: Edit = lambda topic, data: data) -> tuple[Path, int]:
    """Copy the intact records of a file into a file beside it, durably.

    A metadata record named `note` marks the copy. Returns its path and its number of messages.
    Raises OSError where the disk refuses it.
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
