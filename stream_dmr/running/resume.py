"""Continues a run where an earlier one in the same folder ended or was interrupted."""

from collections.abc import Callable, Sequence
from pathlib import Path

from stream_dmr.errors import RecordingError
from stream_dmr.files import natural_order
from stream_dmr.messages import LearntShapes, LocalizedFish
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.reading.known_shapes import learnt_shapes
from stream_dmr.recording.reading.open_recording import open_recordings
from stream_dmr.recording.segments.open_tracks import unfinished_frames
from stream_dmr.recording.segments.recording_files import STEM
from stream_dmr.recording.segments.repair import Repair
from stream_dmr.results.length_store import LengthStore
from stream_dmr.sources.source import ResumePoint, Source


def resume_source(
    source: Source, store: LengthStore, *, on_notice: Callable[[str], None]
) -> dict[str, int] | None:
    """Let a source begin after what earlier runs measured.

    Returns the frames done of each unfinished clip, None where the source has no clips.
    """
    done, frames_done = store.clips_before()
    after_ns = store.resume_after_ns() if source.is_live else store.before.timestamp_ns
    source.listen(on_notice)
    source.resume(
        ResumePoint(after_ns=after_ns, clips_done=frozenset(done), frames_done=frames_done)
    )
    return frames_done if source.has_clips else None


def learnt_before(out: Path, header: RunHeader) -> list[LearntShapes]:
    """What earlier runs in a folder learnt of their fish, from its last segment.

    Nothing where that can't be read, or where fish had other candidate shapes then.
    """
    segments = [*out.glob(f"{STEM}-*.mcap"), *out.glob(f"{STEM}-*.rrd")]
    if header.candidates is None or not segments:
        return []
    try:
        last = open_recordings([max(segments, key=natural_order)])
        earlier = last.header.candidates
        is_same = earlier is not None and earlier.names == header.candidates.names
        return learnt_shapes(last) if is_same else []
    except RecordingError:
        return []


def interrupted_tracks(
    repairs: Sequence[Repair], store: LengthStore, *, on_notice: Callable[[str], None]
) -> list[LocalizedFish]:
    """The frames of fish that were in view at a crash, from the recordings repaired after it."""
    torn = [repair.path for repair in repairs if repair.path.suffix == ".mcap"]
    if not torn:
        return []
    finished = {estimate.track_id for estimate in store.estimates()}
    try:
        return list(unfinished_frames(open_recordings(torn), finished=finished))
    except RecordingError as error:
        on_notice(f"fish that were in view at the crash can't be finished: {error}")
        return []
