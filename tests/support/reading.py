"""Recordings as tests read them."""

from collections.abc import Collection, Iterator
from pathlib import Path

from stream_dmr.messages import Message
from stream_dmr.recording.codec import decode
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.reading import open_recordings
from stream_dmr.recording.topics import TOPICS


def read_header(path: Path) -> RunHeader:
    return open_recordings([path]).header


def read_metadata(path: Path) -> dict[str, str]:
    return open_recordings([path]).metadata


def read_messages(path: Path, kinds: Collection[type[Message]] = TOPICS) -> Iterator[Message]:
    for kind, payload in open_recordings([path]).payloads(kinds):
        yield decode(kind, payload)
