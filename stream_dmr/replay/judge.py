"""What a replay does with its messages: record them, compare them with the recorded ones, count."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from stream_dmr.messages import Frame, LengthEstimate, Message
from stream_dmr.recording.record import Record, as_recorded
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.settings import RecordingSettings
from stream_dmr.replay.difference import Difference, differences
from stream_dmr.replay.tape import Tape


class Mismatch(NamedTuple):
    """One field in which a recomputed message is not the recorded one."""

    frame_index: int
    track_id: int
    kind: str
    difference: Difference


class Judge:
    """Compares recomputed messages with recorded ones, kind by kind in their order."""

    def __init__(self, tape: Tape, kinds: Sequence[type[Message]]) -> None:
        self._expected = {kind: tape.messages(kind, keep=False) for kind in kinds}
        self.num_compared = 0
        self.mismatches: list[Mismatch] = []

    def compare(self, computed: Message) -> None:
        """Compare the next one of its kind."""
        logged = next(self._expected[type(computed)], None)
        self.num_compared += 1
        if logged is None:
            self._note(computed, Difference("message", "none", "one more"))
            return
        for difference in differences(logged, computed):
            self._note(computed, difference)

    def finish(self) -> None:
        """What was recorded and not computed is missing."""
        for rest in self._expected.values():
            for logged in rest:
                self._note(logged, Difference("message", "one", "none"))

    def _note(self, message: Message, difference: Difference) -> None:
        track_id = getattr(message, "track_id", 0)
        kind = type(message).__name__
        self.mismatches.append(Mismatch(message.frame_index, track_id, kind, difference))


@dataclass
class Scribe:
    """Takes every message of the replay, as `Recorder` does of a run, and passes it on."""

    _tape: Tape
    _recorder: Recorder | None
    _judge: Judge | None
    _settings: RecordingSettings
    _recomputed: Sequence[type[Message]]
    final: list[LengthEstimate] = field(default_factory=list)
    num_frames: int = 0
    _first_ns: int | None = None
    _last_ns: int = 0

    @property
    def recorded_s(self) -> float:
        """From the first frame to the last."""
        return (self._last_ns - (self._first_ns or 0)) / 1e9 if self.num_frames else 0.0

    def take(self, message: Message) -> Message:
        """Record, compare, count."""
        if type(message) in self._recomputed:
            return self._take_new(message)
        payload = self._tape.payload(message)
        if isinstance(message, Frame):
            self.num_frames += 1
            self._first_ns = message.timestamp_ns if self._first_ns is None else self._first_ns
            self._last_ns = message.timestamp_ns
        if self._recorder is not None:
            encoding = partial(bytes, payload)
            self._recorder.put(Record(message=message, whole=message, encoding=encoding))
        return message

    def _take_new(self, message: Message) -> Message:
        if self._recorder is not None:
            message = self._recorder.write(message)
        else:
            message = as_recorded(message, self._settings)
        if self._judge is not None:
            self._judge.compare(message)
        if isinstance(message, LengthEstimate) and message.is_final:
            self.final.append(message)
        return message
