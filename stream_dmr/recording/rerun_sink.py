"""recording.rrd: the view of a run, and, with `rrd_messages`, its exact messages as well."""

import json
import time
import zlib
from pathlib import Path

import numpy as np
import rerun as rr

from stream_dmr.errors import OutputError
from stream_dmr.messages import Frame
from stream_dmr.recording.codec import encode
from stream_dmr.recording.header import Record, RunHeader
from stream_dmr.recording.pictures import compress
from stream_dmr.recording.rerun_draw import Drawing
from stream_dmr.recording.rerun_view import RUN, blueprint
from stream_dmr.recording.settings import RecordingSettings

NAME = "recording.rrd"
_HEADER = ["messages", "header"]
_FLUSH_TIMEOUT_S = 30.0
_EPOCH_NS = 10**17  # timestamps above are since 1970 (this is 1973), below since the start


class RerunSink:
    """Draws every record, through a stream of its own: Rerun's global one is left alone.

    Rerun says nothing of a full disk until it is flushed, so that comes every `flush_s`.
    """

    def __init__(self, out_dir: Path, header: RunHeader, settings: RecordingSettings) -> None:
        self.path = out_dir / NAME
        self._flush_ns = int(settings.flush_s * 1e9)
        self._with_messages = settings.rrd_messages
        self._closed = False
        self._rec = rr.RecordingStream("stream-dmr")
        self._rec.set_log_time_enabled(False)
        self._rec.set_log_tick_enabled(False)
        layout = blueprint(header.calibration)
        try:
            self._rec.set_sinks(rr.FileSink(str(self.path)), default_blueprint=layout)
        except RuntimeError as error:
            raise self._refusal(error) from error
        self._drawing = Drawing(self._rec, header)
        self._log_header(header)
        self._flush()

    def write(self, record: Record) -> None:
        """Draw one record; OutputError where the disk refuses it."""
        message = record.message
        self._rec.set_time("frame", sequence=message.frame_index)
        if message.timestamp_ns > _EPOCH_NS:
            self._rec.set_time("time", timestamp=np.datetime64(message.timestamp_ns, "ns"))
        else:
            self._rec.set_time("time", duration=np.timedelta64(message.timestamp_ns, "ns"))
        self._drawing.draw(record)
        if self._with_messages:
            self._log_message(record)
        if time.monotonic_ns() >= self._flush_at_ns:
            self._flush()

    def close(self) -> None:
        """Write what is buffered and the file's footer. Idempotent."""
        if self._closed:
            return
        self._closed = True
        try:
            self._flush()
        finally:
            self._rec.disconnect()

    def _log_header(self, header: RunHeader) -> None:
        metadata = header.metadata()
        rows = "\n".join(f"| {name} | `{value}` |" for name, value in metadata.items())
        text = f"| | |\n|---|---|\n{rows}\n\n```toml\n{header.config_toml}\n```"
        self._rec.log(RUN, rr.TextDocument(text, media_type="text/markdown"), static=True)
        if self._with_messages:
            parts = {"run.json": json.dumps(metadata).encode(), **header.attachments()}
            for name, data in parts.items():
                self._rec.log([*_HEADER, name], _blob(data), static=True)

    def _log_message(self, record: Record) -> None:
        """The message as in the .mcap, but a frame by reference: its JPEG is drawn already."""
        message, payload = record.message, record.payload
        if isinstance(message, Frame):
            payload = encode(message, picture=compress(message.image, format="reference"))
        self._rec.log(record.topic.payload, _blob(payload))

    def _flush(self) -> None:
        try:
            self._rec.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except RuntimeError as error:
            self._closed = True
            raise self._refusal(error) from error
        self._flush_at_ns = time.monotonic_ns() + self._flush_ns

    def _refusal(self, error: RuntimeError) -> OutputError:
        return OutputError(
            f"{self.path}: expected a file with room to write to, got: {error}; "
            "make room or choose another --out"
        )


def _blob(data: bytes) -> rr.AnyValues:
    """Bytes with their CRC-32, since an .rrd has no checksum of its own."""
    return rr.AnyValues(
        payload=np.frombuffer(data, np.uint8), crc32=np.array([zlib.crc32(data)], np.uint32)
    )
