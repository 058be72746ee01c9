"""The files of a recording, or of one segment of it: an .mcap and an .rrd of the same name."""

from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from stream_dmr.errors import ConfigError
from stream_dmr.recording.mcap.mcap_sink import ExtraTopics, McapSink
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.messages.sink import FileSink
from stream_dmr.recording.rerun.rrd_sink import RrdSink

STEM = "recording"


def open_recording_files(
    out_dir: Path,
    header: RunHeader,
    settings: RecordingSettings,
    *,
    stem: str = STEM,
    segment_number: int | None = None,
) -> list[FileSink]:
    """The file sinks that the settings ask for, the .mcap first.

    Raises OutputError where the disk refuses one, ConfigError where a package is missing.
    """
    files: list[FileSink] = []
    with ExitStack() as undo:
        if settings.mcap:
            mcap = McapSink(
                out_dir / f"{stem}.mcap",
                header,
                flush_s=settings.flush_s,
                extras=list(_extra_topics(header, settings)),
                segment_number=segment_number,
            )
            undo.callback(mcap.close)
            files.append(mcap)
        if settings.rrd:
            files.append(RrdSink(out_dir / f"{stem}.rrd", header, settings))
        undo.pop_all()
    return files


def _extra_topics(header: RunHeader, settings: RecordingSettings) -> Iterator[ExtraTopics]:
    if settings.foxglove:
        with _requires_extra("foxglove", "foxglove = true"):
            from stream_dmr.recording.mcap.foxglove_topics import FoxgloveTopics
        yield FoxgloveTopics(header, settings)
    if settings.frames == "h264":
        with _requires_extra("h264", 'frames = "h264"'):
            from stream_dmr.recording.mcap.h264_topic import H264Topic
        yield H264Topic(crf=settings.h264_crf)


@contextmanager
def _requires_extra(extra: str, setting: str) -> Generator[None]:
    """Turn a missing package into a ConfigError that names how to install it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"[recording] {setting}: expected the package {error.name}, found none; install it "
            f"with: pip install 'stream-dmr[{extra}]'"
        ) from error
