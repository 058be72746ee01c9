"""Write, read and convert .rrd files.

Reads the messages that an .rrd carries beside its view.

An .rrd has no checksums, so each message and each part of the header has a CRC-32 beside it, the
messages of each type are numbered, and a last row says how many there are.
"""

import errno
import json
import os
import subprocess
import time
import warnings
import zlib
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from heapq import merge
from importlib.resources import files
from multiprocessing import get_context
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun_bindings import flush_and_cleanup_orphaned_recordings

from stream_dmr.errors import OutputError, RecordingError
from stream_dmr.files import free_bytes, is_locked
from stream_dmr.messages import Message
from stream_dmr.recording.codec import check_version
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.record import Record
from stream_dmr.recording.rerun.blueprint import RUN, blueprint
from stream_dmr.recording.rerun.scene_drawing import SceneDrawing, payload_columns
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import END, TOPICS, RecordingSettings


def new_stream(sink: Any, header: RunHeader) -> rr.RecordingStream:
    """A stream into one sink, with the layout of the view, without timelines of logging time."""
    rec = rr.RecordingStream("stream-dmr")
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    layout = blueprint(header)
    rec.set_sinks(sink, default_blueprint=layout)
    layout.end()
    return rec


def end_streams() -> None:
    """End the threads of streams that are disconnected and that nobody holds any more.

    Rerun does so at the next `rr.init` only, which a process that measures video after video, or
    a camera's segments, never calls.
    """
    flush_and_cleanup_orphaned_recordings()


_HEADER_ENTITY = ["messages", "header"]
# One for so many of the .mcap, which is the record of truth: what is flushed together is sent in a
# third of the time, and Rerun keeps some kilobytes of each piece until the file is closed.
_MCAP_FLUSHES = 4
_BEGIN_BYTES = 1 << 18  # chosen: several times what Rerun writes before it is first flushed
_FLUSH_TIMEOUT_S = 30.0  # chosen: a slow disk is waited for, a hanging one is not


class RrdSink:
    """Draws every record into a stream of its own; Rerun's global stream is not touched.

    Rerun reports a full disk only when it is flushed, which is done every four times `flush_s`.
    """

    def __init__(self, path: Path, header: RunHeader, settings: RecordingSettings) -> None:
        self.path = path
        self._flush_ns = int(_MCAP_FLUSHES * settings.flush_s * 1e9)
        self._with_messages = settings.rrd_messages
        self._closed = False
        self._counts: dict[str, int] = {}  # rows of the header, by entity
        try:
            _require_room(path)
            self._rec = new_stream(rr.FileSink(str(path)), header)
        except RuntimeError as error:
            raise self._output_error(error) from error
        self._drawing = SceneDrawing(self._rec, header, settings)
        log_run(self._rec, header)
        if self._with_messages:
            self._log_header(header)
        self._flush()

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.path.name

    def write(self, record: Record) -> None:
        """Draw one record. Raises OutputError where the disk refuses it, and closes the file."""
        self._drawing.draw(record)
        if self._with_messages:
            self._drawing.add_payload(record)
        if time.monotonic_ns() >= self._flush_at_ns:
            self._flush()

    def close(self) -> None:
        """Write what is buffered and the file's footer. Idempotent. OutputError."""
        if self._closed:
            return
        self._closed = True
        try:
            self._drawing.finish()
            if self._with_messages:
                self._log_end()
            self._flush()
        finally:
            self._rec.disconnect()
            del self._rec, self._drawing
            end_streams()

    def _log_header(self, header: RunHeader) -> None:
        parts = {"run.json": json.dumps(header.metadata()).encode(), **header.attachments()}
        for name, data in parts.items():
            self._log([*_HEADER_ENTITY, name], data)
            self._counts["/".join(["", *_HEADER_ENTITY, name])] = 1

    def _log_end(self) -> None:
        """Log the number of messages, by which a reader knows when some are missing."""
        messages = {f"/{path}": count for path, count in self._drawing.num_payloads.items()}
        self._log(END.split("/"), json.dumps(self._counts | messages).encode())

    def _log(self, path: Sequence[object], data: bytes) -> None:
        self._rec.log(
            [*path], rr.AnyValues(drop_untyped_nones=True, **payload_columns(data)), static=True
        )

    def _flush(self) -> None:
        self._drawing.send()
        try:
            self._rec.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except RuntimeError as error:
            self._closed = True
            self._rec.disconnect()
            raise self._output_error(error) from error
        self._flush_at_ns = time.monotonic_ns() + self._flush_ns

    def _output_error(self, error: RuntimeError) -> OutputError:
        return OutputError(
            f"{self.path}: expected a file with room to write to, got: {error}; "
            "make room or choose another --out"
        )


def _require_room(path: Path) -> None:
    """Raise RuntimeError where a file can't be begun: Rerun would wait for ever for its layout."""
    with suppress(OSError):  # which Rerun reports
        if free_bytes(path.parent) < _BEGIN_BYTES:
            raise RuntimeError(os.strerror(errno.ENOSPC))


def log_run(rec: rr.RecordingStream, header: RunHeader) -> None:
    """Log metadata and settings of the run as a document, for people."""
    rows = "\n".join(f"| {name} | `{value}` |" for name, value in header.metadata().items())
    text = f"| | |\n|---|---|\n{rows}\n\n```toml\n{header.config_toml}\n```"
    rec.log(RUN, rr.TextDocument(text, media_type="text/markdown"), static=True)


def rerun_program() -> str:
    """Path of the program."""
    return str(files("rerun_cli").joinpath("rerun"))


def copy_readable_chunks(rrd: Path, target: Path) -> None:
    """Write what can be read of an .rrd into `target`, with a footer."""
    command = [rerun_program(), "rrd", "filter", "--continue-on-error", str(rrd), "-o", str(target)]
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


_HEADER = "/messages/header/"
_FOOTER_MAGIC = b"RRF2FOOT"  # in the last 16 bytes of every closed file, by experiment
_DAMAGE_ERRORS = (ValueError, RuntimeError, OSError, KeyError, TypeError, pa.ArrowException)

Rows = dict[str, list[tuple[int, int, bytes]]]
"""Entity path -> number, capture time in ns and encoding of each message."""


class RrdRecording:
    """One .rrd with `rrd_messages`, in memory; the protocol is `Recording` of `open_recording`."""

    def __init__(self, path: Path) -> None:
        """Read the file. Raises RecordingError where it can't be read or holds no messages."""
        self.path = path
        self.warnings: list[str] = []
        self._rows = _read_apart(path)
        self._check_end()
        self.header = self._read_header()

    def payloads(
        self, kinds: Collection[type[Message]], selection: Selection = EVERYTHING
    ) -> Iterator[tuple[type[Message], bytes]]:
        """Type and encoding of the messages of `kinds`, merged by capture time."""

        def wanted(kind: type[Message]) -> Iterator[tuple[int, type[Message], bytes]]:
            for _, timestamp_ns, payload in self._rows.get(f"/{TOPICS[kind].payload}", ()):
                if selection.includes_time(timestamp_ns):
                    yield timestamp_ns, kind, payload

        for _, kind, payload in merge(*map(wanted, kinds), key=itemgetter(0)):
            yield kind, payload

    def carried_over(self) -> Iterator[bytes]:
        """Nothing: it is only in the .mcap."""
        return iter(())

    def video(self, selection: Selection = EVERYTHING) -> Iterator[bytes]:
        """Nothing: it is only in the .mcap."""
        return iter(())

    def _check_end(self) -> None:
        """Compare with the last row: without it the file is torn, with other counts damaged."""
        end = self._rows.pop(f"/{END}", None)
        counts = {entity: len(rows) for entity, rows in self._rows.items()}
        self.ends_early = end is None
        self.is_thinned = False
        if end is None:
            whole = sum(count for entity, count in counts.items() if _HEADER not in entity)
            self.warnings.append(
                f"{self.path}: still being written; {whole} messages so far"
                if is_locked(self.path.parent)
                else f"{self.path}: torn; {whole} messages are whole, what came after is lost"
            )
        elif json.loads(end[0][2]) != counts:
            raise RecordingError(f"{self.path}: damaged: parts of it are missing")

    def _read_header(self) -> RunHeader:
        parts = {
            entity.removeprefix(_HEADER): rows[0][2]
            for entity, rows in self._rows.items()
            if entity.startswith(_HEADER)
        }
        if "run.json" not in parts:
            raise RecordingError(
                f"{self.path}: expected a recording that carries its messages, got only the view; "
                "replay the .mcap, or record with rrd_messages = true"
            )
        self.metadata: dict[str, str] = json.loads(parts.pop("run.json"))
        try:
            check_version(int(self.metadata["codec_version"]))
            return RunHeader.from_parts(self.metadata, parts)
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}") from error
        except KeyError as error:
            raise RecordingError(f"{self.path}: lacks {error}, not a complete recording") from error


def _read_apart(path: Path) -> Rows:
    """Read in a process of its own: on some damaged files Rerun's reader crashes its process."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_read, path).result()
        except BrokenProcessPool as error:
            raise RecordingError(
                f"{path}: damaged: Rerun's reader crashes on it; replay the .mcap instead"
            ) from error


def _read(path: Path) -> Rows:
    try:
        return _rows_in(path)
    except _DAMAGE_ERRORS as error:
        if path.is_file() and not is_closed(path) and (rows := _read_readable_chunks(path)):
            return rows
        raise RecordingError(
            f"{path}: expected a whole recording (.rrd), but it can't be read: {error}"
        ) from error


def _rows_in(path: Path) -> Rows:
    from rerun.chunk import RrdReader  # in the other process only

    rows: Rows = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a missing footer, which `RrdRecording.warnings` tells
        for chunk in RrdReader(str(path)).stream():
            entity = str(chunk.entity_path)
            if entity.startswith("/messages/"):
                rows.setdefault(entity, []).extend(_rows_of(chunk.to_record_batch()))
    for entity, found in rows.items():
        found.sort()
        if [number for number, _, _ in found] != list(range(len(found))):
            raise ValueError(f"messages are missing in {entity}")
    return rows


def is_closed(path: Path) -> bool:
    """True where an .rrd has its footer."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 16, 0))
        return _FOOTER_MAGIC in file.read()


def _read_readable_chunks(path: Path) -> Rows:
    """The readable messages of a file that was not closed, which Rerun's reader refuses."""
    with TemporaryDirectory() as folder:
        whole = Path(folder) / "whole.rrd"
        copy_readable_chunks(path, whole)
        try:
            return _rows_in(whole)
        except _DAMAGE_ERRORS:
            return {}


def _rows_of(batch: pa.RecordBatch) -> Iterator[tuple[int, int, bytes]]:
    """Numbers, times and encodings; the header's rows are static: number and time 0."""
    times, numbers = [0] * batch.num_rows, [0] * batch.num_rows
    if "time" in batch.schema.names:
        times = batch.column("time").cast(pa.int64()).to_pylist()
    if "number" in batch.schema.names:
        numbers = [values[0].as_py() for values in batch.column("number")]
    columns = (numbers, times, batch.column("payload"), batch.column("crc32"))
    for number, timestamp_ns, payload, crc32 in zip(*columns, strict=True):
        data = np.asarray(payload.values).astype(np.uint8, copy=False).tobytes()
        if zlib.crc32(data) != crc32.values[0].as_py():
            raise ValueError("the checksum of a message is wrong")
        yield number, timestamp_ns, data
