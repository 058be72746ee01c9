"""What a run does with every message beside passing it on: numbers, stores, records, counts it."""

from collections import Counter, defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import median

from stream_dmr.messages import FishCrop, Frame, LengthEstimate, LocalizedFish, Message
from stream_dmr.recording.recorder import Recorder
from stream_dmr.results.store import LengthStore
from stream_dmr.running.error_policy import DriftWatch
from stream_dmr.running.run_observer import RunObserver

INTERRUPTED = "interrupted by a restart, finished with what was recorded; it may count twice"


class Tally:
    """Takes every message of the chain, in the thread of its stage.

    A finished fish goes to the store before anything else is done with it, so that no failure of
    what follows can lose it. After an earlier run in the same folder, ids go on where that one
    stopped; frames as well where the source has no end and no annotations count its frames.
    """

    def __init__(
        self,
        recorder: Recorder,
        store: LengthStore,
        observer: RunObserver,
        *,
        numbers_frames_on: bool,
        keeps: int | None = None,
        clips: Mapping[str, int] | None = None,
        left: Sequence[LocalizedFish] = (),
        drift: DriftWatch | None = None,
    ) -> None:
        """`keeps`: of the finished fish, so many of the last ones; of weeks at sea not all.

        `clips`: the source is a folder of clips, of which so many frames were done before.

        `left`: frames of fish that a crash interrupted, and that this run finishes.
        """
        self.final: deque[LengthEstimate] = deque(maxlen=keeps)
        self.num_frames = 0
        self._drift = drift
        self._ious: defaultdict[int, list[float]] = defaultdict(list)  # of the open tracks
        self._left = {fish.track_id for fish in left}
        for fish in left:
            self._take_iou(fish)
        self._recorder = recorder
        self._store = store
        self._observer = observer
        self._first_id = store.before.track_id
        self._first_frame = store.before.frame_index if numbers_frames_on else 0
        self._clips = None if clips is None else Counter(clips)
        self._in_flight: deque[str] = deque()  # the clips of frames that are in the chain
        self._track_ids: set[int] = set()

    def record(self, message: Message) -> Message:
        """Return the message as the next stage is to get it."""
        match message:
            case Frame(frame_index=index):
                message = replace(message, frame_index=index + self._first_frame)
                if self._drift is not None:
                    self._drift.take_frame(message)
                self._in_flight.append(message.source)
                self._store.frame_passed(
                    frame_index=message.frame_index, timestamp_ns=message.timestamp_ns
                )
            case FishCrop(track_id=track_id):
                message = replace(message, track_id=track_id + self._first_id)
                self._store.reserve_track(message.track_id)
            case LocalizedFish():
                self._take_iou(message)
            case LengthEstimate(is_final=True):
                self._finish(message)
                self._observer.fish_finished(message)
            case _:
                pass
        if self._store.trouble:
            self._observer.warn(
                f"{self._store.path}: {self._store.trouble}; lengths wait in memory"
            )
        message = self._recorder.write(message)
        self._observer.take(message)
        if isinstance(message, LengthEstimate):
            self._track_ids.add(message.track_id)
            self._observer.fish_seen(len(self._track_ids))
        return message

    def _take_iou(self, fish: LocalizedFish) -> None:
        if fish.accepted and fish.iou is not None:
            self._ious[fish.track_id].append(fish.iou)

    def _finish(self, estimate: LengthEstimate) -> None:
        accepted = self._ious.pop(estimate.track_id, [])
        iou = median(accepted) if accepted else None
        flags = [] if self._drift is None else self._drift.take_fish(iou, estimate.timestamp_ns)
        if estimate.track_id in self._left:
            flags.append(INTERRUPTED)
        self._store.add(estimate, iou=iou, flags=flags)
        self.final.append(estimate)

    def frame_done(self) -> None:
        """Count a frame that has left the last stage."""
        self.num_frames += 1
        clip = self._in_flight.popleft()
        if self._clips is not None:
            self._clips[clip] += 1
            self._store.clip_progress(clip, frames_done=self._clips[clip])
        self._observer.frame_done()
