"""The files of a recording: one .mcap and one .rrd of the same name."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.errors import ConfigError
from stream_dmr.recording.mcap.sink import ExtraTopics, McapSink
from stream_dmr.recording.messages.header import RunHeader
from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.rerun.sink import RerunSink
from stream_dmr.recording.settings import RecordingSettings

STEM = "recording"


@runtime_checkable
class Sink(Protocol):
    """One kind of output."""

    def write(self, record: Record, /) -> None:
        """Take one record; OutputError where the disk refuses it."""
        ...

    def close(self) -> None:
        """Leave a valid file. Idempotent."""
        ...


@runtime_checkable
class Flushing(Protocol):
    """A sink that keeps records for a moment and writes them together."""

    def flush_due(self) -> None:
        """Write what was kept long enough; OutputError where the disk refuses it."""
        ...


@runtime_checkable
class FileSink(Sink, Protocol):
    """A sink that writes one file."""

    path: Path  # of the file when it is closed


OpenSinks = Callable[[Path, RunHeader, RecordingSettings], Sequence[Sink]]
"""Opens what records a run in this folder. Raises as `open_files` does."""


def open_files(
    out_dir: Path,
    header: RunHeader,
    settings: RecordingSettings,
    *,
    stem: str = STEM,
    number: int | None = None,
) -> list[FileSink]:
    """The sinks that the settings ask for, in this order; `number` is that of a segment.

    Raises OutputError where the disk refuses one, ConfigError where a package is missing.
    """
    files: list[FileSink] = []
    with ExitStack() as undo:
        if settings.mcap:
            path, extras = out_dir / f"{stem}.mcap", list(_extras(header, settings))
            files.append(
                McapSink(path, header, flush_s=settings.flush_s, extras=extras, number=number)
            )
            undo.callback(files[0].close)
        if settings.rrd:
            files.append(RerunSink(out_dir / f"{stem}.rrd", header, settings))
        undo.pop_all()
    return files


def _extras(header: RunHeader, settings: RecordingSettings) -> Iterator[ExtraTopics]:
    if settings.foxglove:
        with _needs("foxglove", "foxglove = true"):
            from stream_dmr.recording.foxglove import FoxgloveView
        yield FoxgloveView(header, settings)
    if settings.frames == "h264":
        with _needs("h264", 'frames = "h264"'):
            from stream_dmr.recording.mcap.video import H264Topic
        yield H264Topic(crf=settings.h264_crf)


@contextmanager
def _needs(extra: str, setting: str) -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"[recording] {setting}: expected the package {error.name}, found none; install it "
            f"with: pip install 'stream-dmr[{extra}]'"
        ) from error
