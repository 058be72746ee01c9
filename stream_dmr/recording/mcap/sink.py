"""An .mcap: the record of truth, whole up to the last second after a crash.

Written as `.mcap.part` and renamed once it is closed. Whatever is needed to read the
messages comes first, and every chunk of messages is complete in itself.
"""

import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import IO, Any, Protocol, cast, runtime_checkable

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from mcap_protobuf.schema import register_schema

from stream_dmr.errors import OutputError
from stream_dmr.files import TransactionalFile, rename_durably, sync_path
from stream_dmr.messages import Frame, LocalizedFish
from stream_dmr.recording.messages.header import RunHeader
from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.messages.schema import schema_bytes
from stream_dmr.recording.messages.topics import CARRIED, RUN, SEGMENT, SPANS, TOPICS
from stream_dmr.version import __version__

PART = ".part"  # after the name of a file that is not closed yet
_CHUNK_BYTES = 256 * 1024
_MEDIA_TYPES = {".toml": "application/toml", ".yaml": "application/yaml"}


@runtime_checkable
class ExtraTopics(Protocol):
    """What other programs read, in protobuf schemas of theirs."""

    @property
    def topics(self) -> Mapping[str, Any]:
        """Topic -> class of its messages."""
        ...

    def draw(self, record: Record, /) -> Iterable[tuple[str, Any]]:
        """Topics and messages that follow from a record."""
        ...


Extras = Sequence[ExtraTopics]


class McapSink:
    """Writes every record, with the capture time as its log time.

    A flush comes with the first record that is `flush_s` of wall clock after the last flush, or
    with `flush_due`; in a segment also after `flush_s` of capture time, of which more passes while
    a stall is made up for. A full disk
    ends the recording: the file keeps its whole chunks and is closed without an index, which
    readers do without; where not even that has room, it stays behind as `.part`.
    """

    def __init__(
        self,
        path: Path,
        header: RunHeader,
        *,
        flush_s: float,
        extras: Extras = (),
        number: int | None = None,
    ) -> None:
        """`number` is that of a segment. Raises OutputError where the disk refuses the file."""
        self.path = path
        self._part = path.with_name(path.name + PART)
        if self._part.exists():
            raise OutputError(
                f"{self._part}: expected no unfinished recording, found one; repair it with "
                f"stream-dmr recover {path.parent}"
            )
        self._flush_ns = int(flush_s * 1e9)
        self._is_segment = number is not None
        self._last_ns = 0  # the latest capture time
        self._channels: dict[type, int] = {}
        self._carried_channel = 0
        self._extras, self._extra_channels = extras, dict[str, int]()
        self._sequences: Counter[int] = Counter()
        self._spans: dict[int, tuple[int, int]] = {}  # first and last capture time of each track
        self._closed = False
        try:
            self._file = TransactionalFile(self._part)
        except OSError as error:
            raise self._refusal(error) from error
        try:
            sync_path(path.parent)
            self._writer = _start(self._file, header, number)
            self._register_topics()
            self._flush()
        except OSError as error:
            self._file.close()
            with suppress(OSError):
                self._part.unlink(missing_ok=True)
            raise self._refusal(error) from error

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._file.tell()

    def write(self, record: Record) -> None:
        """Append one record; OutputError where the disk refuses it, and the recording is over."""
        if self._closed:
            raise ValueError(f"{self.path} is closed")
        timestamp_ns = record.message.timestamp_ns
        with self._refusing():
            self._add(self._channels[type(record.message)], timestamp_ns, record.payload)
            if not isinstance(record.message, Frame):
                self._saw(record.message.track_id, timestamp_ns)
            for topic, drawn in chain.from_iterable(e.draw(record) for e in self._extras):
                channel = self._extra_channels[topic]
                self._add(channel, timestamp_ns, drawn.SerializeToString())
            self._last_ns = max(self._last_ns, timestamp_ns)
            if self._is_flush_due():
                self._flush()

    def flush_due(self) -> None:
        """Flush what has waited for `flush_s` though no record came; OutputError as above."""
        if self._waits and not self._closed and time.monotonic_ns() >= self._flush_at_ns:
            with self._refusing():
                self._flush()

    def carry(self, records: Iterable[Record]) -> None:
        """Append, durably, what is taken over from before, in a topic of its own."""
        with self._refusing():
            for record in records:
                self._add(self._carried_channel, record.message.timestamp_ns, record.payload)
            self._flush()

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._end_without_index(self._file.tell())
            raise self._refusal(error) from error

    def close(self) -> None:
        """Write the index, make it durable and give the file its name. Idempotent."""
        if self._closed:
            return
        whole = self._file.tell()
        try:
            self._flush()
            whole = self._file.tell()
            spans = json.dumps(self._spans).encode()
            self._writer.add_attachment(0, 0, SPANS, "application/json", spans)
            self._writer.finish()
            self._end()
        except OSError as error:
            self._end_without_index(whole)
            raise self._refusal(error) from error

    def _add(self, channel: int, timestamp_ns: int, data: bytes) -> None:
        self._waits = True
        self._sequences[channel] += 1
        self._writer.add_message(
            channel, timestamp_ns, data, timestamp_ns, self._sequences[channel]
        )

    def _saw(self, track_id: int, timestamp_ns: int) -> None:
        first, last = self._spans.get(track_id, (timestamp_ns, timestamp_ns))
        self._spans[track_id] = min(first, timestamp_ns), max(last, timestamp_ns)

    def _register_topics(self) -> None:
        for kind, row in TOPICS.items():
            schema = self._writer.register_schema(row.schema, "protobuf", schema_bytes())
            self._channels[kind] = self._writer.register_channel(row.topic, "protobuf", schema)
            if self._is_segment and kind is LocalizedFish:
                self._carried_channel = self._writer.register_channel(CARRIED, "protobuf", schema)
        for topic, kind in chain.from_iterable(e.topics.items() for e in self._extras):
            schema = register_schema(self._writer, kind)
            channel = self._writer.register_channel(topic, "protobuf", schema)
            self._extra_channels[topic] = channel

    def _is_flush_due(self) -> bool:
        is_late = self._is_segment and self._last_ns >= self._flush_at_capture_ns
        return is_late or time.monotonic_ns() >= self._flush_at_ns

    def _flush(self) -> None:
        self._writer.flush()
        self._file.sync()
        self._waits = False
        self._flush_at_ns = time.monotonic_ns() + self._flush_ns
        self._flush_at_capture_ns = self._last_ns + self._flush_ns

    def _end(self) -> None:
        self._file.sync()
        self._closed = True
        self._file.close()
        rename_durably(self._part, self.path)

    def _end_without_index(self, whole: int) -> None:
        """Keep the first `whole` bytes, which end with a record, and close after them."""
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
        try:
            self._file.truncate(whole)
            self._file.write(builder.end() + MCAP0_MAGIC)
            self._end()
        except OSError:  # the caller reports the first failure
            if not self._closed:
                self._closed = True
                self._file.close()

    def _refusal(self, error: OSError) -> OutputError:
        kept = f"; what came before is kept in {self.path.parent}" if self._channels else ""
        return OutputError(
            f"{self.path}: expected a folder with room to write to, got: {error.strerror}{kept}; "
            "make room or choose another --out"
        )


def new_writer(file: TransactionalFile) -> Writer:
    """A writer of chunks that stand alone, with checksums on all that it writes."""
    writer = Writer(
        cast(IO[bytes], file),
        chunk_size=_CHUNK_BYTES,
        compression=CompressionType.ZSTD,
        enable_data_crcs=True,  # else metadata and attachments have no checksum
    )
    writer.start(profile="stream-dmr", library=f"stream-dmr {__version__}")
    return writer


def _start(file: TransactionalFile, header: RunHeader, number: int | None) -> Writer:
    writer = new_writer(file)
    writer.add_metadata(RUN, header.metadata())
    if number is not None:
        writer.add_metadata(SEGMENT, {"number": str(number)})
    for name, data in header.attachments().items():
        media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/protobuf")
        writer.add_attachment(0, 0, name, media_type, data)
    return writer
