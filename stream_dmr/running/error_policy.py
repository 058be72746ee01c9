"""What a run without an end needs: to go on where the one before stopped, and after a bad frame."""

from collections.abc import Callable, Sequence

from stream_dmr.errors import OutputError, RecordingError, UserError
from stream_dmr.messages import Frame, LocalizedFish
from stream_dmr.recording.reading.reader import open_recordings
from stream_dmr.recording.segments.open_tracks import unfinished
from stream_dmr.recording.segments.recover import Repair
from stream_dmr.results.store import LengthStore
from stream_dmr.running.drift import FitWatch, SceneWatch, decode_scene, encode_scene
from stream_dmr.running.run_settings import DriftSettings
from stream_dmr.sources.source import ResumePoint, Source

_MOST_IN_A_ROW = 100  # failures with no frame between them that went through: the run is broken


def go_on(
    source: Source, store: LengthStore, *, on_notice: Callable[[str], None]
) -> dict[str, int] | None:
    """Let a source go on after an earlier run; of a folder of clips, the frames done of each."""
    done, frames_done = store.clips_before()
    after_ns = store.resume_after_ns() if source.is_live else store.before.timestamp_ns
    source.listen(on_notice)
    source.resume(
        ResumePoint(after_ns=after_ns, clips_done=frozenset(done), frames_done=frames_done)
    )
    return frames_done if source.has_clips else None


def left_open(
    repairs: Sequence[Repair], store: LengthStore, *, on_notice: Callable[[str], None]
) -> list[LocalizedFish]:
    """What a crash left of the fish that were in view: their frames, by the repaired recordings."""
    torn = [repair.path for repair in repairs if repair.path.suffix == ".mcap"]
    if not torn:
        return []
    finished = {estimate.track_id for estimate in store.estimates()}
    try:
        return list(unfinished(open_recordings(torn), finished=finished))
    except RecordingError as error:
        on_notice(f"fish that were in view at the crash can't be finished: {error}")
        return []


class DriftWatch:
    """Looks after scene and fits of a run, and marks the lengths measured since an alarm."""

    def __init__(
        self, store: LengthStore, settings: DriftSettings, *, on_notice: Callable[[str], None]
    ) -> None:
        self._store = store
        self._on_notice = on_notice
        kept = store.scene()
        self._scene = SceneWatch(settings, reference=None if kept is None else decode_scene(kept))
        self._is_kept = self._scene.reference is not None
        self._fits = FitWatch(settings, reference=store.first_ious(settings.reference_fish))
        self._alarms: tuple[str, ...] = ()

    def take_frame(self, frame: Frame) -> None:
        """Look at what the camera sees."""
        self._scene.take(frame.image, frame.timestamp_ns)
        if not self._is_kept and self._scene.reference is not None:
            self._store.keep_scene(encode_scene(self._scene.reference))
            self._is_kept = True
        self._say(frame.timestamp_ns)

    def take_fish(self, iou: float | None, timestamp_ns: int) -> list[str]:
        """Look at the fits of a finished fish; what a reader of its length must know."""
        if iou is not None:
            self._fits.take(iou)
        self._say(timestamp_ns)
        return list(self._alarms)

    def _say(self, timestamp_ns: int) -> None:
        alarms = tuple(alarm for alarm in (self._scene.alarm, self._fits.alarm) if alarm)
        if [_kind(alarm) for alarm in alarms] == [_kind(alarm) for alarm in self._alarms]:
            return
        self._alarms = alarms
        text = "; ".join(alarms) or "the camera sees again what it was calibrated for"
        self._store.note("drift", text, timestamp_ns=timestamp_ns)
        self._on_notice(f"{text}; lengths are marked from now on" if alarms else text)


def _kind(alarm: str) -> str:
    return alarm.partition(" (")[0]


class Tolerance:
    """Says whether a chain goes on after an exception: at sea, one frame must not cost the rest.

    An input that is wrong stays wrong, so it ends the run; a full disk may be emptied.
    """

    def __init__(self, *, is_endless: bool, on_notice: Callable[[str], None]) -> None:
        self._is_endless = is_endless
        self._on_notice = on_notice
        self._in_a_row = 0

    def frame_done(self) -> None:
        """Take note that the chain works."""
        self._in_a_row = 0

    def allows(self, stage: str, error: Exception) -> bool:
        """Whether to go on after this exception in this stage."""
        if not self._is_endless or self._in_a_row >= _MOST_IN_A_ROW:
            return False
        if isinstance(error, UserError) and not isinstance(error, OutputError):
            return False
        self._in_a_row += 1
        self._on_notice(f"a frame failed in {stage}: {type(error).__name__}: {error}")
        return True
