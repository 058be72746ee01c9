"""Records a run: every message of every stage, to every sink."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Protocol, runtime_checkable

from stream_dmr.errors import OutputError
from stream_dmr.messages import FishCrop, Frame, Message
from stream_dmr.recording.codec import encode
from stream_dmr.recording.header import Record, RunHeader
from stream_dmr.recording.mcap_sink import McapSink
from stream_dmr.recording.pictures import Picture, compress, decompress
from stream_dmr.recording.rerun_sink import RerunSink
from stream_dmr.recording.settings import RecordingSettings
from stream_dmr.tables import Tables


@runtime_checkable
class Sink(Protocol):
    """One kind of output."""

    def write(self, record: Record, /) -> None:
        """Take one record; OutputError where the disk refuses it."""
        ...

    def close(self) -> None:
        """Leave a valid file. Idempotent."""
        ...


class Recorder:
    """Writes recording.mcap, recording.rrd, lengths.csv and frames.csv into one folder.

    Thread-safe; the messages of one stage must come in their order. Raises OutputError where the
    folder can't be written to.
    """

    def __init__(self, out_dir: Path, header: RunHeader, settings: RecordingSettings) -> None:
        self._settings = settings
        self._lock = Lock()
        self._sinks: list[Sink] = []
        self._refused: list[Sink] = []
        _make_folder(out_dir)
        with ExitStack() as undo:
            undo.callback(self.close)
            self._sinks.append(Tables(out_dir))
            if settings.mcap:
                self._sinks.append(McapSink(out_dir, header, flush_s=settings.flush_s))
            if settings.rrd:
                self._sinks.append(RerunSink(out_dir, header, settings))
            undo.pop_all()

    def write(self, message: Message) -> Message:
        """Record a message; returns it as a replay will read it back.

        Hand the returned message on to the next stage: with a lossy picture setting its pixels are
        those that the recording holds, and only then does a replay repeat the run exactly.
        """
        record = self._encode(message)
        with self._lock, ExitStack() as stack:
            for sink in self._sinks:
                stack.callback(self._write_to, sink, record)
        return record.message

    def _write_to(self, sink: Sink, record: Record) -> None:
        """Write to one sink; once the disk has refused it, never again.

        The others go on: where the pictures no longer have room, the lengths still may.
        """
        if sink in self._refused:
            return
        try:
            sink.write(record)
        except OutputError:
            self._refused.append(sink)
            raise

    def close(self) -> None:
        """Close every sink, also where another one fails; then raise the failure. Idempotent."""
        with self._lock, ExitStack() as stack:
            for sink in self._sinks:
                stack.callback(sink.close)

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _encode(self, message: Message) -> Record:
        if isinstance(message, Frame):
            return self._encode_frame(message)
        if isinstance(message, FishCrop) and self._settings.crops == "jpeg":
            picture = self._jpeg(message)
            payload = encode(message, picture=picture)
            message = replace(message, image=decompress(picture))
            return Record(message=message, payload=payload, picture=None)
        return Record(message=message, payload=encode(message), picture=None)

    def _encode_frame(self, frame: Frame) -> Record:
        if self._settings.frames == "jpeg":
            picture = self._jpeg(frame)
            payload = encode(frame, picture=picture)
            frame = replace(frame, image=decompress(picture))
        else:
            picture = self._jpeg(frame) if self._settings.rrd else None
            payload = encode(frame, picture=compress(frame.image, format="reference"))
        return Record(message=frame, payload=payload, picture=picture)

    def _jpeg(self, message: Frame | FishCrop) -> Picture:
        quality = self._settings.jpeg_quality
        return compress(message.image, format="jpeg", jpeg_quality=quality)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: expected a folder to write to, got: {error.strerror}; choose another --out"
        ) from error
