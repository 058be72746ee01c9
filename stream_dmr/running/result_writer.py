"""Writes what a run's chain gives: lengths into the store, every message into the recording."""

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from types import MappingProxyType

from stream_dmr.messages import (
    FishCrop,
    Frame,
    LengthEstimate,
    LocalizedFish,
    Message,
    Position,
)
from stream_dmr.recording.recorder import Recorder
from stream_dmr.results.catch_facts import CatchFacts
from stream_dmr.results.kept_positions import (
    POSITIONS,
    KeptPosition,
    PositionThinner,
    position_values,
)
from stream_dmr.results.length_store import LengthStore
from stream_dmr.results.lengths_table import LengthsTable
from stream_dmr.results.store_rows import INTERRUPTED
from stream_dmr.running.drift_alarms import DriftAlarms
from stream_dmr.running.haul_log import HaulLog
from stream_dmr.sensors.sensors_settings import SensorsSettings

_SENSORS = SensorsSettings()


class ResultWriter:
    """Writes every message of the chain, called in the thread of its stage.

    A finished fish goes to the store first, so that no failure of what follows can lose it.
    """

    def __init__(
        self,
        store: LengthStore,
        lengths: LengthsTable,
        recorder: Recorder,
        *,
        clips: Mapping[str, int] | None = None,
        interrupted: Sequence[LocalizedFish] = (),
        flags: Mapping[int, Sequence[str]] = MappingProxyType({}),
        drift: DriftAlarms | None = None,
        sensors: SensorsSettings = _SENSORS,
        hauls: HaulLog | None = None,
        on_notice: Callable[[str], None],
    ) -> None:
        """`clips`: frames done of each clip before; None where the source has no clips.

        `interrupted`: frames of fish that a crash interrupted, and that this run finishes. `flags`:
        what is known already, by track, of the fish of a recording.
        """
        self._store, self._lengths, self._recorder = store, lengths, recorder
        self._flags = flags
        self._hauls = hauls
        self._thinner = PositionThinner(keep_s=sensors.keep_s, max_gap_s=sensors.max_gap_s)
        self._drift, self._on_notice = drift, on_notice
        self._clips = None if clips is None else Counter(clips)
        self._clips_in_chain: deque[str] = deque()  # of the frames that are in the chain, in order
        self._interrupted = {fish.track_id for fish in interrupted}
        self._ious: defaultdict[int, list[float]] = defaultdict(list)  # by track, while it is open
        for fish in interrupted:
            self._take_iou(fish)

    def write(self, message: Message) -> Message:
        """Write a message; returns it as the next stage must get it, see `Recorder.write`."""
        self.store(message)
        message = self._recorder.write(message)
        self.tabulate(message)
        return message

    def store(self, message: Message) -> None:
        """Keep what lengths.db holds of a message, before anything else is done with it."""
        match message:
            case Frame():
                self._take_frame(message)
            case FishCrop():
                self._store.reserve_track(message.track_id)
            case LocalizedFish():
                self._take_iou(message)
            case LengthEstimate(is_final=True):
                self._store_fish(message)
            case LengthEstimate():
                self._take_fish(message)
            case Position():
                self._take_position(message)
            case _:
                pass
        states = self._recorder.states
        states.report(self._store.path.name, self._store.trouble)
        if self._store.trouble:
            self._on_notice(f"{self._store.path}: {self._store.trouble}; lengths wait in memory")

    def tabulate(self, message: Message) -> None:
        """Append a finished fish to lengths.csv."""
        if isinstance(message, LengthEstimate) and message.is_final:
            self._lengths.add(message)
            self._recorder.states.report("lengths.csv", self._lengths.trouble)

    def frame_done(self) -> None:
        """Take note that a frame has left the last stage: its clip is measured so far."""
        self._store.frame_done()
        if self._hauls is not None:
            self._hauls.frame_done()
        if self._clips is not None:
            clip = self._clips_in_chain.popleft()
            self._clips[clip] += 1
            self._store.clip_progress(clip, frames_done=self._clips[clip])

    def finish(self) -> None:
        """The last message was written: keep the last position, from which others are interpolated.

        Idempotent.
        """
        self._keep_positions(self._thinner.finish())
        if self._hauls is not None:
            self._hauls.finish()

    def _take_position(self, position: Position) -> None:
        if self._hauls is not None:
            self._hauls.take_position(position)
        kept = self._thinner.take(position)
        if self._thinner.gap_s:
            line = f"no positions for {self._thinner.gap_s:.0f} s"
            self._store.note("positions", line, timestamp_ns=position.timestamp_ns)
        self._keep_positions(kept)

    def _keep_positions(self, positions: Sequence[KeptPosition]) -> None:
        for kept in positions:
            name = str(kept.timestamp_ns)
            self._store.append(POSITIONS, name, position_values(kept), is_urgent=False)

    def _take_frame(self, frame: Frame) -> None:
        if self._hauls is not None:
            self._hauls.take_frame(frame.timestamp_ns)
        if self._clips is not None:
            self._clips_in_chain.append(frame.source)
        if self._drift is not None:
            self._drift.take_frame(frame)
        self._store.frame_passed(frame_index=frame.frame_index, timestamp_ns=frame.timestamp_ns)

    def _take_iou(self, fish: LocalizedFish) -> None:
        if fish.accepted and fish.iou is not None:
            self._ious[fish.track_id].append(fish.iou)

    def _store_fish(self, estimate: LengthEstimate) -> None:
        ious = self._ious.pop(estimate.track_id, [])
        iou = median(ious) if ious else None
        flags = [*self._flags.get(estimate.track_id, ())]
        if self._drift is not None:
            flags += self._drift.take_fish(iou, estimate.timestamp_ns)
        if estimate.track_id in self._interrupted:
            flags.append(INTERRUPTED)
        self._take_fish(estimate)
        self._store.add(estimate, iou=iou, flags=flags, catch=CatchFacts.of(estimate))

    def _take_fish(self, estimate: LengthEstimate) -> None:
        if self._hauls is not None:
            self._hauls.take_fish(estimate)
