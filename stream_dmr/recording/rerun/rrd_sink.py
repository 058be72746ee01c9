"""Write .rrd files: the view of a run, with its messages."""

import errno
import json
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import rerun as rr
from rerun_bindings import flush_and_cleanup_orphaned_recordings

from stream_dmr.errors import OutputError
from stream_dmr.files import free_bytes
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.record import Record
from stream_dmr.recording.rerun.blueprint import RUN, blueprint
from stream_dmr.recording.rerun.scene_drawing import SceneDrawing, payload_columns
from stream_dmr.recording.topics import END, RecordingSettings


def new_stream(sink: Any, header: RunHeader) -> rr.RecordingStream:
    """A stream into one sink, with the layout of the view, without timelines of logging time."""
    rec = rr.RecordingStream("stream-dmr")
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    layout = blueprint(header)
    rec.set_sinks(sink, default_blueprint=layout)
    layout.end()
    return rec


_HEADER_ENTITY = ["messages", "header"]
# Flushes of the .mcap, the record of truth, for one of the .rrd: rows flushed together are sent in
# a third of the time, and Rerun keeps some kilobytes of each piece until the file is closed.
_MCAP_FLUSHES = 4
_BEGIN_BYTES = 1 << 18  # chosen: several times the bytes that Rerun writes before its first flush
_FLUSH_TIMEOUT_S = 30.0  # chosen: long enough for a slow disk, not for a hanging one


class RrdSink:
    """Draws every record into a stream of its own; Rerun's global stream is not touched.

    Rerun reports a full disk only when it is flushed, which is done every four times `flush_s`.
    """

    def __init__(self, path: Path, header: RunHeader, settings: RecordingSettings) -> None:
        self.path, self.name = path, path.name
        self._flush_ns = int(_MCAP_FLUSHES * settings.flush_s * 1e9)
        self._with_messages = settings.rrd_messages
        self._closed = False
        self._counts: dict[str, int] = {}  # rows of the header, by entity
        try:
            with suppress(OSError):  # which Rerun reports
                if free_bytes(path.parent) < _BEGIN_BYTES:  # it would wait for ever for its layout
                    raise RuntimeError(os.strerror(errno.ENOSPC))
            self._rec = new_stream(rr.FileSink(str(path)), header)
        except RuntimeError as error:
            raise self._output_error(error) from error
        self._drawing = SceneDrawing(self._rec, header, settings)
        log_run(self._rec, header)
        if self._with_messages:
            parts = {"run.json": json.dumps(header.metadata()).encode(), **header.attachments()}
            for name, data in parts.items():
                self._log([*_HEADER_ENTITY, name], data)
                self._counts["/".join(["", *_HEADER_ENTITY, name])] = 1
        self._flush()

    def write(self, record: Record) -> None:
        """Draw one record. Raises OutputError if the disk refuses it, and closes the file."""
        self._drawing.draw(record)
        if self._with_messages:
            self._drawing.add_payload(record)
        if time.monotonic_ns() >= self._flush_at_ns:
            self._flush()

    def close(self) -> None:
        """Write the buffer and the file's footer. Idempotent. OutputError."""
        if self._closed:
            return
        self._closed = True
        try:
            self._drawing.finish()
            if self._with_messages:
                # The number of messages, by which a reader notices missing messages.
                counts = {f"/{path}": n for path, n in self._drawing.num_payloads.items()}
                self._log(END.split("/"), json.dumps(self._counts | counts).encode())
            self._flush()
        finally:
            self._rec.disconnect()
            del self._rec, self._drawing
            # End the threads of disconnected streams without references. Rerun does so only at the
            # next `rr.init`, which many videos or segments in one process never call.
            flush_and_cleanup_orphaned_recordings()

    def _log(self, path: Sequence[object], data: bytes) -> None:
        values = rr.AnyValues(drop_untyped_nones=True, **payload_columns(data))
        self._rec.log([*path], values, static=True)

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


def log_run(rec: rr.RecordingStream, header: RunHeader) -> None:
    """Log metadata and settings of the run as a document, for people."""
    rows = "\n".join(f"| {name} | `{value}` |" for name, value in header.metadata().items())
    text = f"| | |\n|---|---|\n{rows}\n\n```toml\n{header.config_toml}\n```"
    rec.log(RUN, rr.TextDocument(text, media_type="text/markdown"), static=True)
