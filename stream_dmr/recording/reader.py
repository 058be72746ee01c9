"""Reads a recording back: its header and its messages, with every checksum verified."""

import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from zstandard import ZstdError

from stream_dmr.errors import RecordingError
from stream_dmr.messages import Message
from stream_dmr.recording.codec import check_version, decode
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.topics import TOPICS

# What the mcap library lets through on damaged bytes; its CRC error is a ValueError.
_DAMAGE = (McapError, ValueError, KeyError, RuntimeError, StopIteration, struct.error, ZstdError)


def read_header(path: Path) -> RunHeader:
    """The inputs of the run that wrote a .mcap; RecordingError where it can't be read."""
    with _open(path) as reader:
        attachments = {item.name: item.data for item in reader.iter_attachments()}
        try:
            return RunHeader.from_parts(_metadata(reader), attachments)
        except KeyError as error:
            raise RecordingError(f"{path}: lacks {error}, not a complete recording") from error


def read_metadata(path: Path) -> dict[str, str]:
    """Who wrote a .mcap, from what, and with which versions."""
    with _open(path) as reader:
        return _metadata(reader)


def read_messages(path: Path, types: Collection[type[Message]] | None = None) -> Iterator[Message]:
    """The messages of a .mcap in the order they were written; only those of `types` if given.

    Raises RecordingError for a file that is damaged, torn, or of a newer codec; what comes before
    the damage has then been given already.
    """
    kinds = {TOPICS[kind].topic: kind for kind in types or TOPICS}
    with _open(path) as reader:
        _metadata(reader)
        for _, channel, record in reader.iter_messages(list(kinds), log_time_order=False):
            yield decode(kinds[channel.topic], record.data)


def _metadata(reader: SeekingReader) -> dict[str, str]:
    run = next((item.metadata for item in reader.iter_metadata() if item.name == "run"), None)
    if run is None:
        raise RecordingError("not a recording of stream-dmr: it lacks the metadata record 'run'")
    check_version(int(run["codec_version"]))
    return run


@contextmanager
def _open(path: Path) -> Iterator[SeekingReader]:
    try:
        with path.open("rb") as stream:
            yield SeekingReader(stream, validate_crcs=True)
    except OSError as error:
        raise RecordingError(
            f"{path}: expected a recording (.mcap), got: {error.strerror}; check the path"
        ) from error
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except _DAMAGE as error:
        raise RecordingError(
            f"{path}: expected a whole recording (.mcap), got a torn or damaged one "
            f"({error}); recover it with: stream-dmr recover {path.parent}"
        ) from error
