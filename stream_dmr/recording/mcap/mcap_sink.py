"""Writes an .mcap, the record of truth: after a crash it is complete up to the last second.

It is written as `.mcap.part` and renamed when it is closed. Whatever is needed to read the messages
comes first, and every chunk of messages can be read without the others.
"""

import json
import time
from collections import Counter
from collections.abc import Generator, Iterable, Mapping, Sequence
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
from stream_dmr.messages import FishMessage, LocalizedFish
from stream_dmr.recording.codec import schema_bytes
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.record import Record
from stream_dmr.recording.topics import CARRIED_OVER, RUN, SECOND_TOPICS, SEGMENT, SPANS, TOPICS
from stream_dmr.version import __version__

PART = ".part"  # suffix of a file that is not closed yet
_CHUNK_BYTES = 256 * 1024  # on kill -9 chunks of 1 MiB lost some three frames, smaller chunks fewer
_MEDIA_TYPES = {f".{kind}": f"application/{kind}" for kind in ("toml", "yaml", "json")}


@runtime_checkable
class ExtraTopics(Protocol):
    """Topics for other programs, in their own protobuf schemas."""

    @property
    def topics(self) -> Mapping[str, Any]:
        """Topic -> protobuf class of its messages."""
        ...

    def draw(self, record: Record, /) -> Iterable[tuple[str, Any]]:
        """The topics and protobuf messages that show a record."""
        ...


class McapSink:
    """Writes every record, with its capture time as the log time.

    Flushed by the first record that comes `flush_s` of wall clock after the last flush, and by
    `flush_due`; a segment also after `flush_s` of capture time, which passes faster while a source
    catches up. A full disk ends the file: its complete chunks are kept and closed without an index,
    which readers don't need; without room even for that, it stays behind as `.part`.
    """

    def __init__(
        self,
        path: Path,
        header: RunHeader,
        *,
        flush_s: float,
        extras: Sequence[ExtraTopics] = (),
        segment_number: int | None = None,
    ) -> None:
        """`flush_s` in seconds. Raises OutputError if the disk refuses the file."""
        self.path, self.name = path, path.name
        self._part = path.with_name(path.name + PART)
        if self._part.exists():
            raise OutputError(
                f"{self._part}: expected no unfinished recording, found one; repair it with "
                f"stream-dmr recover {path.parent}"
            )
        self._flush_ns = int(flush_s * 1e9)
        self._is_segment = segment_number is not None
        self._last_ns = 0  # the latest capture time written
        self._channels: dict[str, int] = {}  # by topic
        self._carried_over_channel = 0
        self._extras, self._extra_channels = extras, dict[str, int]()
        self._sequences: Counter[int] = Counter()
        self._spans: dict[int, tuple[int, int]] = {}  # first and last capture time of each track
        self._closed = False
        try:
            self._file = TransactionalFile(self._part)
        except OSError as error:
            raise self._output_error(error) from error
        try:
            sync_path(path.parent)
            self._writer = new_writer(self._file)
            self._writer.add_metadata(RUN, header.metadata())
            if segment_number is not None:
                self._writer.add_metadata(SEGMENT, {"number": str(segment_number)})
            for name, data in header.attachments().items():
                media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/protobuf")
                self._writer.add_attachment(0, 0, name, media_type, data)
            self._register_topics(header)
            self._flush()
        except OSError as error:
            self._file.close()
            with suppress(OSError):
                self._part.unlink(missing_ok=True)
            raise self._output_error(error) from error

    @property
    def size(self) -> int:
        return self._file.tell()

    def write(self, record: Record) -> None:
        """Append one record. Raises OutputError if the disk refuses it, and closes the file."""
        if self._closed:
            raise ValueError(f"{self.path} is closed")
        timestamp_ns = record.message.timestamp_ns
        with self._closing_on_error():
            self._add(self._channels[record.topic.topic], timestamp_ns, record.payload)
            if record.is_second:  # neither its fish nor its clock are the recording's
                return
            if isinstance(record.message, FishMessage):
                track_id = record.message.track_id
                first, last = self._spans.get(track_id, (timestamp_ns, timestamp_ns))
                self._spans[track_id] = min(first, timestamp_ns), max(last, timestamp_ns)
            for topic, drawn in chain.from_iterable(e.draw(record) for e in self._extras):
                self._add(self._extra_channels[topic], timestamp_ns, drawn.SerializeToString())
            self._last_ns = max(self._last_ns, timestamp_ns)
            is_late = self._is_segment and self._last_ns >= self._flush_at_capture_ns
            if is_late or time.monotonic_ns() >= self._flush_at_ns:
                self._flush()

    def flush_due(self) -> None:
        """Flush records that waited for `flush_s` without another one. Raises OutputError."""
        if self._has_unflushed and not self._closed and time.monotonic_ns() >= self._flush_at_ns:
            with self._closing_on_error():
                self._flush()

    def carry_over(self, records: Iterable[Record]) -> None:
        """Append, durably, the frames of open tracks from before this segment. OutputError."""
        with self._closing_on_error():
            for record in records:
                self._add(self._carried_over_channel, record.message.timestamp_ns, record.payload)
            self._flush()

    @contextmanager
    def _closing_on_error(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            self._end_without_index(self._file.tell())
            raise self._output_error(error) from error

    def close(self) -> None:
        """Write the index, make the file durable and rename it. Idempotent. OutputError."""
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
            raise self._output_error(error) from error

    def _add(self, channel: int, timestamp_ns: int, data: bytes) -> None:
        self._has_unflushed = True
        self._sequences[channel] += 1
        log_ns = max(0, timestamp_ns)  # a position before a video's start; MCAP has no time for it
        self._writer.add_message(channel, log_ns, data, log_ns, self._sequences[channel])

    def _register_topics(self, header: RunHeader) -> None:
        rows = [*TOPICS.items(), *(() if header.second is None else SECOND_TOPICS.items())]
        for kind, row in rows:
            schema = self._writer.register_schema(row.schema, "protobuf", schema_bytes())
            self._channels[row.topic] = self._writer.register_channel(row.topic, "protobuf", schema)
            if self._is_segment and kind is LocalizedFish:
                self._carried_over_channel = self._writer.register_channel(
                    CARRIED_OVER, "protobuf", schema
                )
        for topic, kind in chain.from_iterable(e.topics.items() for e in self._extras):
            schema = register_schema(self._writer, kind)
            self._extra_channels[topic] = self._writer.register_channel(topic, "protobuf", schema)

    def _flush(self) -> None:
        self._writer.flush()
        self._file.sync()
        self._has_unflushed = False
        self._flush_at_ns = time.monotonic_ns() + self._flush_ns
        self._flush_at_capture_ns = self._last_ns + self._flush_ns

    def _end(self) -> None:
        self._file.sync()
        self._closed = True
        self._file.close()
        rename_durably(self._part, self.path)

    def _end_without_index(self, whole: int) -> None:
        """Keep the first `whole` bytes, which end with a record, and close the file after them."""
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

    def _output_error(self, error: OSError) -> OutputError:
        kept = f"; what came before is kept in {self.path.parent}" if self._channels else ""
        return OutputError(
            f"{self.path}: expected a folder with room to write to, got: {error.strerror}{kept}; "
            "make room or choose another --out"
        )


def new_writer(file: TransactionalFile) -> Writer:
    """A writer of zstd chunks, with checksums on everything that it writes."""
    writer = Writer(
        cast(IO[bytes], file),
        chunk_size=_CHUNK_BYTES,
        compression=CompressionType.ZSTD,
        enable_data_crcs=True,  # else metadata and attachments have no checksum
    )
    writer.start(profile="stream-dmr", library=f"stream-dmr {__version__}")
    return writer
