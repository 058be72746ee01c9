"""An .rrd: the view of a run, and, with `rrd_messages`, its messages as well."""

import json
import time
from collections.abc import Sequence
from pathlib import Path

import rerun as rr

from stream_dmr.errors import OutputError
from stream_dmr.recording.messages.header import RunHeader
from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.messages.topics import END
from stream_dmr.recording.rerun.blueprint import RUN, blueprint
from stream_dmr.recording.rerun.columns import blob
from stream_dmr.recording.rerun.draw import Drawing
from stream_dmr.recording.settings import RecordingSettings

_HEADER = ["messages", "header"]
_FLUSH_TIMEOUT_S = 30.0


class RerunSink:
    """Draws every record, through a stream of its own: Rerun's global one is left alone.

    Rerun says nothing of a full disk until it is flushed, so that comes every `flush_s`.
    """

    def __init__(self, path: Path, header: RunHeader, settings: RecordingSettings) -> None:
        self.path = path
        self._flush_ns = int(settings.flush_s * 1e9)
        self._with_messages = settings.rrd_messages
        self._closed = False
        self._counts: dict[str, int] = {}  # of the rows of the header, by entity
        self._rec = new_stream()
        try:
            sink = rr.FileSink(str(path))
            self._rec.set_sinks(sink, default_blueprint=blueprint(header.calibration))
        except RuntimeError as error:
            raise self._refusal(error) from error
        self._drawing = Drawing(self._rec, header, settings)
        log_run(self._rec, header)
        if self._with_messages:
            self._log_header(header)
        self._flush()

    def write(self, record: Record) -> None:
        """Draw one record; OutputError where the disk refuses it."""
        self._drawing.draw(record)
        if self._with_messages:
            self._drawing.keep(record)
        if time.monotonic_ns() >= self._flush_at_ns:
            self._flush()

    def close(self) -> None:
        """Write what is buffered and the file's footer. Idempotent."""
        if self._closed:
            return
        self._closed = True
        try:
            self._drawing.send()
            if self._with_messages:
                self._log_end()
            self._flush()
        finally:
            self._rec.disconnect()

    def _log_header(self, header: RunHeader) -> None:
        parts = {"run.json": json.dumps(header.metadata()).encode(), **header.attachments()}
        for name, data in parts.items():
            self._log([*_HEADER, name], data)
            self._counts["/".join(["", *_HEADER, name])] = 1

    def _log_end(self) -> None:
        """How much there is, so that a reader knows when something is missing."""
        messages = {f"/{path}": count for path, count in self._drawing.kept.items()}
        self._log(END.split("/"), json.dumps(self._counts | messages).encode())

    def _log(self, path: Sequence[object], data: bytes) -> None:
        self._rec.log([*path], rr.AnyValues(drop_untyped_nones=True, **blob(data)), static=True)

    def _flush(self) -> None:
        self._drawing.send()
        try:
            self._rec.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except RuntimeError as error:
            self._closed = True
            self._rec.disconnect()
            raise self._refusal(error) from error
        self._flush_at_ns = time.monotonic_ns() + self._flush_ns

    def _refusal(self, error: RuntimeError) -> OutputError:
        return OutputError(
            f"{self.path}: expected a file with room to write to, got: {error}; "
            "make room or choose another --out"
        )


def new_stream() -> rr.RecordingStream:
    """A stream in which nothing is known but what we say."""
    rec = rr.RecordingStream("stream-dmr")
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    return rec


def log_run(rec: rr.RecordingStream, header: RunHeader) -> None:
    """Who recorded this, from what, and with which settings, for people."""
    rows = "\n".join(f"| {name} | `{value}` |" for name, value in header.metadata().items())
    text = f"| | |\n|---|---|\n{rows}\n\n```toml\n{header.config_toml}\n```"
    rec.log(RUN, rr.TextDocument(text, media_type="text/markdown"), static=True)
