"""A recording into an .rrd: the view made again, with every frame drawn."""

from collections.abc import Iterable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from stream_dmr.files import writing_to
from stream_dmr.messages import FittedMesh, Frame, Message
from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.messages.selection import WHOLE, Part
from stream_dmr.recording.messages.topics import TOPICS
from stream_dmr.recording.reading.frame_images import RecordedPictures, SourcePictures
from stream_dmr.recording.reading.reader import messages, open_recordings
from stream_dmr.recording.rerun.meshes import Meshes
from stream_dmr.recording.rerun.sink import RerunSink
from stream_dmr.recording.settings import RecordingSettings

EVERY_FRAME = RecordingSettings(view_rate_hz=1000.0)


def convert(
    recording: Path,
    rrd: Path,
    *,
    frames: Iterable[Frame] | None = None,
    settings: RecordingSettings = EVERY_FRAME,
    part: Part = WHOLE,
) -> Sequence[str]:
    """Draw a recording, or a part of it, into `rrd`, which can be replayed like it.

    Returns what is lost of it, a line each.

    Pictures are those of `frames`, the source's; without them those that the recording holds.
    Raises RecordingError where the recording can't be read, SourceError where a picture isn't the
    recorded one, OutputError where `rrd` can't be written.
    """
    opened = open_recordings([recording])
    meshes = Meshes(opened.header.template, opened.header.candidates)
    pictures = RecordedPictures(opened, part) if frames is None else SourcePictures(frames)
    unfinished = rrd.with_name(f"{rrd.name}.part")
    with closing(RerunSink(unfinished, opened.header, settings)) as sink:
        for message, payload in messages(opened, list(TOPICS), part):
            whole: Message = message
            if isinstance(message, Frame):
                whole = pictures.restore(message, payload)
            elif isinstance(message, FittedMesh):
                whole = meshes.with_vertices(message)
            sink.write(Record(message=message, whole=whole, encoding=partial(bytes, payload)))
    with writing_to(rrd):
        unfinished.replace(rrd)
    return opened.warnings
