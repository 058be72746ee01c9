"""Converts a recording into an .rrd: the view drawn again, with every frame."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from stream_dmr.files import make_folder, replacing
from stream_dmr.messages import FittedMesh, Frame, Message
from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.recording.messages.selection import EVERYTHING, Selection
from stream_dmr.recording.messages.topics import TOPICS
from stream_dmr.recording.reading.frame_images import FrameRestorer, RecordedPictures
from stream_dmr.recording.reading.known_shapes import known_shapes
from stream_dmr.recording.reading.open_recording import decoded_messages, open_recordings
from stream_dmr.recording.reading.required_parts import require_messages, require_selected
from stream_dmr.recording.rerun.rrd_sink import RrdSink
from stream_dmr.recording.view.mesh_rebuilder import MeshRebuilder

EVERY_FRAME = RecordingSettings(view_rate_hz=1000.0)


def convert(
    recording: Path,
    rrd: Path,
    *,
    source: FrameRestorer | None = None,
    settings: RecordingSettings = EVERY_FRAME,
    selection: Selection = EVERYTHING,
) -> Sequence[str]:
    """Draw the selected messages of a recording into `rrd`, which can be replayed as well.

    Pictures are those of `source`; without it those that the recording holds. Returns
    what is lost of the recording, one line each. Raises RecordingError where the recording can't be
    read, UserError where it has nothing of the selection, SourceError where a picture is not the
    recorded one, OutputError where `rrd` can't be written.
    """
    opened = open_recordings([recording])
    require_messages(opened)
    require_selected(opened, selection)
    meshes = MeshRebuilder(opened.header.template, known_shapes(opened))
    pictures = source or RecordedPictures(opened, selection)
    with (
        replacing(make_folder(rrd.parent) / rrd.name) as draft,
        closing(RrdSink(draft, opened.header, settings)) as sink,
    ):
        for message, payload in decoded_messages(opened, list(TOPICS), selection):
            whole: Message = message
            if isinstance(message, Frame):
                whole = pictures.restore(message, payload)
            elif isinstance(message, FittedMesh):
                whole = meshes.with_vertices(message)
            sink.write(Record.of_payload(message, payload, whole=whole))
    return opened.warnings
