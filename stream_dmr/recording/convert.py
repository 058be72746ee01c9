"""A .mcap into an .rrd: the view made again, with every frame drawn."""

from collections.abc import Iterable
from contextlib import closing
from functools import partial
from pathlib import Path

from stream_dmr.messages import FittedMesh, Frame, Message
from stream_dmr.recording.codec import decode
from stream_dmr.recording.meshes import Meshes
from stream_dmr.recording.opened import open_recordings
from stream_dmr.recording.record import Record
from stream_dmr.recording.rerun_sink import RerunSink
from stream_dmr.recording.restored import Pictures
from stream_dmr.recording.settings import RecordingSettings
from stream_dmr.recording.topics import TOPICS
from stream_dmr.recording.whole_file import writing_to

EVERY_FRAME = RecordingSettings(view_rate_hz=1000.0)


def convert(
    recording: Path,
    rrd: Path,
    *,
    frames: Iterable[Frame] | None = None,
    settings: RecordingSettings = EVERY_FRAME,
) -> None:
    """Draw a .mcap, or the folder of a run, into `rrd`, which can be replayed like it.

    `frames` are the source's, for pictures that were recorded by reference; without them, the view
    has no pictures. Raises RecordingError where the recording can't be read, SourceError where a
    picture isn't the recorded one, OutputError where `rrd` can't be written.
    """
    opened = open_recordings([recording])
    meshes = Meshes(opened.header.template)
    pictures = None if frames is None else Pictures(frames)
    part = rrd.with_name(f"{rrd.name}.part")
    with closing(RerunSink(part, opened.header, settings)) as sink:
        for kind, payload in opened.payloads(list(TOPICS)):
            message = decode(kind, payload)
            whole: Message = message
            if isinstance(message, Frame) and pictures is not None:
                whole = pictures.restore(message, payload)
            elif isinstance(message, FittedMesh):
                whole = meshes.with_vertices(message)
            sink.write(Record(message=message, whole=whole, encoding=partial(bytes, payload)))
    with writing_to(rrd):
        part.replace(rrd)
