"""Read an .mcap, also without its end.

Every byte is covered by a checksum: each chunk has one, and so has the data section as a whole,
which is why all of it is read in file order. Some messages or times are read by the index instead,
covered by the checksums of the index and of the chunks that are read.
"""

import json
import struct
import zlib
from collections.abc import Collection, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, AttachmentIndex, Channel, Chunk, DataEnd, Footer, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from stream_dmr.errors import RecordingError
from stream_dmr.files import Snapshot, is_locked
from stream_dmr.messages import LocalizedFish, Message
from stream_dmr.recording.codec import check_version, decode
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.mcap.mcap_sink import PART
from stream_dmr.recording.selection import EVERYTHING, Selection, Spans
from stream_dmr.recording.topics import (
    CARRIED_OVER,
    RECOVERED,
    RUN,
    SEGMENT,
    SPANS,
    THINNED,
    TOPICS,
    VIDEO,
    MessageTypes,
    Topics,
)

# Errors of the mcap library on damaged bytes; its CRC error is a ValueError.
_DAMAGE_ERRORS = (
    *(McapError, ValueError, KeyError, IndexError, RuntimeError, struct.error, ZstdError),
    *(OverflowError, MemoryError, AttributeError, TypeError),
)
_END_ERRORS = (EndOfFile, struct.error)
_FOOTER_BYTES = 1 + 8 + 8 + 8 + 4  # opcode, record length, two offsets, CRC-32
_MAX_RECORD_BYTES = 1 << 30  # a damaged length must not allocate all memory


class McapRecording:
    """One .mcap, as the protocol `Recording` of `open_recording` describes it."""

    def __init__(self, path: Path) -> None:
        """Read the header. Raises RecordingError if not even that can be read.

        A file that a run is writing, and may rename, is read as far as it is now.
        """
        self.path = path
        self._snapshot: Snapshot | None = None
        self.warnings: list[str] = []
        self.metadata: dict[str, str] = {}
        self.is_segment = self.is_thinned = self.ends_early = False
        self.header = self._read_header()
        self.is_being_written = path.suffix == PART and is_locked(path.parent)

    def tracks(self) -> Collection[int]:
        """The track ids in it, read from the index if it has one."""
        if self._index is not None and self._index.tracks is not None:
            return self._index.tracks.keys()
        fish = (payload for _, payload in self.payloads([LocalizedFish]))
        return {decode(LocalizedFish, payload).track_id for payload in fish}

    def carried_over(self) -> Iterator[bytes]:
        for _, message in self._messages([CARRIED_OVER], EVERYTHING) if self.is_segment else ():
            yield message.data

    def payloads(
        self, kinds: MessageTypes, selection: Selection = EVERYTHING, *, of: Topics = TOPICS
    ) -> Iterator[tuple[type[Message], bytes]]:
        """Type and encoding of the messages of `kinds`; only whole messages of a torn file."""
        topics = {of[kind].topic: kind for kind in kinds}
        for topic, message in self._messages(topics, selection):
            yield topics[topic], message.data

    def video(self, selection: Selection = EVERYTHING) -> Iterator[bytes]:
        for _, message in self._messages([VIDEO], selection):
            yield message.data

    def _messages(
        self, topics: Collection[str], selection: Selection
    ) -> Iterator[tuple[str, McapMessage]]:
        is_whole = selection.is_everything and len(topics) >= len(TOPICS)  # to its last byte
        index = None if is_whole else self._index
        if index is not None:
            selection = selection.narrowed_to(index.tracks)
            if not index.has_any(topics, selection):
                return  # without opening it: one of the thousands of a camera
        with self._open() as stream:
            if index is None:
                yield from self._in_order(stream, topics, selection)
            else:
                yield from _by_index(stream, topics, selection)

    @cached_property
    def _index(self) -> "_Index | None":
        with self._open() as stream:
            return None if _is_torn(stream) or not _has_index(stream) else _read_index(stream)

    def _in_order(
        self, stream: IO[bytes], topics: Collection[str], selection: Selection
    ) -> Iterator[tuple[str, McapMessage]]:
        is_torn, count = _is_torn(stream), 0
        wanted: dict[int, str] = {}  # topics by channel
        try:
            for record in _records(stream):
                if isinstance(record, Channel) and record.topic in topics:
                    wanted[record.id] = record.topic
                elif isinstance(record, Footer):
                    _check_index(stream, record)
                elif isinstance(record, McapMessage):
                    count += 1
                    topic = wanted.get(record.channel_id)
                    if topic and selection.includes_time(record.log_time):
                        yield topic, record
        except _END_ERRORS:
            if not is_torn:
                raise
        if is_torn:
            self._warn(
                f"{self.path}: still being written; {count} messages so far"
                if self.is_being_written
                else f"{self.path}: torn; {count} messages are whole, what came after is lost"
            )

    def _warn(self, line: str) -> None:
        if line not in self.warnings:
            self.warnings.append(line)

    def _read_header(self) -> RunHeader:
        attachments: dict[str, bytes] = {}
        with self._open() as stream:
            if not MCAP0_MAGIC.startswith(stream.read(len(MCAP0_MAGIC))):  # also of torn files
                raise RecordingError(
                    "expected a recording (.mcap or .rrd), got a file of another kind; give the "
                    "folder of a run, or the recording in it"
                )
            self.ends_early = _is_torn(stream)
            try:
                for record in _records(stream, emit_chunks=True):
                    if isinstance(record, Chunk):
                        break
                    if isinstance(record, Metadata):
                        self._take(record)
                    elif isinstance(record, Attachment) and record.name != SPANS:
                        attachments[record.name] = record.data
            except _END_ERRORS:
                pass
            try:
                return RunHeader.from_parts(self.metadata, attachments)
            except KeyError as error:
                raise RecordingError(
                    f"expected a recording of stream-dmr, but it lacks {error}; it ends too early "
                    "or is of another program"
                ) from error

    def _take(self, record: Metadata) -> None:
        if record.name == RUN:
            self.metadata = record.metadata
            check_version(int(self.metadata["codec_version"]))
        elif record.name == RECOVERED:
            self._warn(f"{self.path}: recovered after a crash; what came after that is lost")
        self.is_segment |= record.name == SEGMENT
        self.is_thinned |= record.name == THINNED
        self.ends_early |= record.name in (SEGMENT, RECOVERED)

    @contextmanager
    def _open(self) -> Generator[IO[bytes]]:
        try:
            if self._snapshot is None and self.path.suffix == PART:
                self._snapshot = _snapshot(self.path)
            with self._snapshot.open() if self._snapshot else self.path.open("rb") as stream:
                yield stream
        except OSError as error:
            raise RecordingError(
                f"{self.path}: expected a recording (.mcap or .rrd), got: {error.strerror}; "
                "check the path"
            ) from error
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}") from error
        except _DAMAGE_ERRORS as error:
            raise RecordingError(
                f"{self.path}: expected a whole recording, got a damaged one ({error}); "
                "what was read before the damage is sound"
            ) from error


def _snapshot(path: Path) -> Snapshot:
    """A snapshot of a file that may just be getting its final name."""
    try:
        return Snapshot(path)
    except FileNotFoundError:
        return Snapshot(path.with_suffix(""))


def is_torn(path: Path) -> bool:
    with path.open("rb") as stream:
        return _is_torn(stream)


def _is_torn(stream: IO[bytes]) -> bool:
    """True if a file lacks the magic bytes at its end; seeks back to the start."""
    size = stream.seek(0, 2)
    stream.seek(max(size - len(MCAP0_MAGIC), 0))
    end = stream.read()
    stream.seek(0)
    is_only_begun = size < 2 * len(MCAP0_MAGIC)  # a file begins with the same bytes
    return is_only_begun or end != MCAP0_MAGIC


def whole_records(path: Path) -> Iterator[object]:
    """Every record of a file, up to its end or to the first damage in it."""
    with path.open("rb") as stream, suppress(*_DAMAGE_ERRORS, *_END_ERRORS):
        yield from _records(stream)


def _by_index(
    stream: IO[bytes], topics: Collection[str], selection: Selection
) -> Iterator[tuple[str, McapMessage]]:
    _check_index(stream, _footer(stream))
    stream.seek(0)
    summary = SeekingReader(stream, validate_crcs=True).get_summary() or Summary()
    wanted = {
        n: channel.topic for n, channel in summary.channels.items() if channel.topic in topics
    }
    # The library's own search has all chunks in memory before it gives the first message out.
    for index in summary.chunk_indexes:
        has_wanted = not wanted.keys().isdisjoint(index.message_index_offsets)
        if not has_wanted or not selection.overlaps(
            index.message_start_time, index.message_end_time
        ):
            continue
        stream.seek(index.chunk_start_offset + 1 + 8)  # opcode and length
        for record in breakup_chunk(Chunk.read(ReadDataStream(stream)), validate_crc=True):
            if (
                isinstance(record, McapMessage)
                and record.channel_id in wanted
                and selection.includes_time(record.log_time)
            ):
                yield wanted[record.channel_id], record


@dataclass(frozen=True, kw_only=True)
class _Index:
    """What the end of a file says of its messages."""

    topics: frozenset[str]  # of all its messages
    first_ns: int  # capture times
    last_ns: int
    tracks: Spans | None  # None if the file has no such record

    def has_any(self, topics: Iterable[str], selection: Selection) -> bool:
        """False if no message is of these topics and of the selected time."""
        return not self.topics.isdisjoint(topics) and selection.overlaps(
            self.first_ns, self.last_ns
        )


def _read_index(stream: IO[bytes]) -> _Index:
    _check_index(stream, _footer(stream))
    stream.seek(0)
    summary = SeekingReader(stream, validate_crcs=True).get_summary()
    if summary is None or summary.statistics is None:
        raise ValueError("its index has no statistics")
    counts = summary.statistics.channel_message_counts
    return _Index(
        topics=frozenset(summary.channels[n].topic for n, count in counts.items() if count),
        first_ns=summary.statistics.message_start_time,
        last_ns=summary.statistics.message_end_time,
        tracks=_spans(stream, summary.attachment_indexes),
    )


def _spans(stream: IO[bytes], attachments: Iterable[AttachmentIndex]) -> Spans | None:
    for index in attachments:
        if index.name == SPANS:
            stream.seek(index.offset)
            record = stream.read(index.length)  # opcode and length (9 bytes), content, CRC-32
            if zlib.crc32(record[9:-4]) != int.from_bytes(record[-4:], "little"):
                raise ValueError(f"the checksum of {SPANS} is wrong")
            text = record[-4 - index.data_size : -4]
            return {int(track_id): tuple(span) for track_id, span in json.loads(text).items()}
    return None


def _has_index(stream: IO[bytes]) -> bool:
    """False if a full disk left no room for the index."""
    footer = _footer(stream)
    stream.seek(0)
    return footer.summary_start > 0


def _footer(stream: IO[bytes]) -> Footer:
    stream.seek(-_FOOTER_BYTES - len(MCAP0_MAGIC), 2)
    opcode, _, *fields = struct.unpack("<BQQQI", stream.read(_FOOTER_BYTES))
    if opcode != Opcode.FOOTER:
        raise ValueError("it has no footer")
    return Footer(*fields)


def _check_index(stream: IO[bytes], footer: Footer) -> None:
    """Compare the checksum of the index, which the mcap library writes and never checks."""
    if footer.summary_crc:
        place = stream.tell()
        stream.seek(footer.summary_start)
        rest = stream.read()[: -len(MCAP0_MAGIC) - 4]
        stream.seek(place)
        if zlib.crc32(rest) != footer.summary_crc:
            raise ValueError("the checksum of its index is wrong")


def _records(stream: IO[bytes], *, emit_chunks: bool = False) -> Iterator[object]:
    reader = StreamReader(
        stream, emit_chunks=True, validate_crcs=True, record_size_limit=_MAX_RECORD_BYTES
    )
    is_data_checked = False
    for record in reader.records:
        # The kind of a record has no checksum that is compared before the record is given out.
        if isinstance(record, McapMessage):
            raise ValueError("a message lies outside of the chunks")
        if isinstance(record, Footer) and not is_data_checked:
            raise ValueError("the checksum of its data is missing")
        is_data_checked |= isinstance(record, DataEnd)
        if isinstance(record, Chunk) and not emit_chunks:
            yield from breakup_chunk(record, validate_crc=True)
        else:
            yield record
