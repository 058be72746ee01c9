"""What takes the records of a run: the interfaces of every output."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.recording.messages.run_header import RunHeader


@runtime_checkable
class Sink(Protocol):
    """One kind of output."""

    @property
    def name(self) -> str:
        """What people know it by: the name of its file."""
        ...

    def write(self, record: Record, /) -> None:
        """Take one record. Raises OutputError where the disk refuses it."""
        ...

    def close(self) -> None:
        """Leave a valid file. Idempotent. Raises OutputError where the disk refuses its end."""
        ...


@runtime_checkable
class BufferedSink(Sink, Protocol):
    """A sink that keeps records for a moment and writes them together."""

    def flush_due(self) -> None:
        """Write what was kept long enough. Raises OutputError where the disk refuses it."""
        ...


@runtime_checkable
class FileSink(Sink, Protocol):
    """A sink that writes one file."""

    path: Path  # of the file when it is closed


SinkFactory = Callable[[Path, RunHeader, RecordingSettings], Sequence[Sink]]
"""Opens the sinks that record a run in a folder. Raises as `open_recording_files` does."""
