"""A .mcap into an .rrd: the view made again, with every frame drawn."""

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from stream_dmr.errors import SourceError
from stream_dmr.messages import FittedMesh, Frame, Message
from stream_dmr.recording.codec import decode, reference
from stream_dmr.recording.meshes import Meshes
from stream_dmr.recording.pictures import checksum
from stream_dmr.recording.reader import read_header, read_payloads
from stream_dmr.recording.record import Record
from stream_dmr.recording.rerun_sink import RerunSink
from stream_dmr.recording.settings import RecordingSettings

EVERY_FRAME = RecordingSettings(view_rate_hz=1000.0)


def convert(
    mcap: Path,
    rrd: Path,
    *,
    frames: Iterable[Frame] | None = None,
    settings: RecordingSettings = EVERY_FRAME,
) -> None:
    """Draw `mcap` into `rrd`, which can be replayed like it.

    `frames` are the source's, for pictures that were recorded by reference; without them, the view
    has no pictures. Raises RecordingError where the recording can't be read, SourceError where a
    picture isn't the recorded one, OutputError where `rrd` can't be written.
    """
    header = read_header(mcap)
    meshes = Meshes(header.template)
    pictures = None if frames is None else _Pictures(frames)
    part = rrd.with_name(f"{rrd.name}.part")
    with closing(RerunSink(part, header, settings)) as sink:
        for kind, payload in read_payloads(mcap):
            message = decode(kind, payload)
            whole: Message = message
            if isinstance(message, Frame) and pictures is not None:
                whole = pictures.restore(message, payload)
            elif isinstance(message, FittedMesh):
                whole = meshes.with_vertices(message)
            sink.write(Record(message=message, whole=whole, encoding=partial(bytes, payload)))
    part.replace(rrd)


class _Pictures:
    """Finds pictures that were recorded by reference, in the order of the recording."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames: Iterator[Frame] = iter(frames)

    def restore(self, frame: Frame, payload: bytes) -> Frame:
        recorded = reference(payload)
        if recorded.format != "reference":
            return frame
        for found in self._frames:
            if found.frame_index == frame.frame_index:
                break
        else:
            raise SourceError(
                f"the recording has frame {frame.frame_index}, the source ends before it; "
                "give the source that was recorded"
            )
        if recorded.crc32 and checksum(found.image) != recorded.crc32:
            raise SourceError(
                f"frame {frame.frame_index}: the source's picture is not the recorded one; "
                "give the source that was recorded"
            )
        return replace(frame, image=found.image)
