"""What a replay does with its messages: record them, compare them with the recorded ones, count."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from stream_dmr.messages import Frame, LengthEstimate, Message
from stream_dmr.recording.messages.record import Record, as_recorded
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.settings import RecordingSettings
from stream_dmr.replaying.difference import Difference, differences
from stream_dmr.replaying.recorded_messages import Tape


class Mismatch(NamedTuple):
    """One field in which a recomputed message is not the recorded one."""

    frame_index: int
    track_id: int
    kind: str
    difference: Difference


class Judge:
    """Compares recomputed messages with recorded ones, kind by kind in the order of their frames.

    The final length of a fish is compared with the recorded one wherever that lies: where a
    recording was cut off, or goes on in another file, a track may end at another moment.
    """

    def __init__(
        self, tape: Tape, kinds: Sequence[type[Message]], *, leave_out: Collection[int] = ()
    ) -> None:
        """`leave_out`: tracks that a replay of this recording can't repeat."""
        self._leave_out = leave_out
        self._final: dict[int, LengthEstimate] = {}  # recorded, not computed yet
        self._early: dict[int, LengthEstimate] = {}  # computed, not read yet
        self._expected = {kind: _Peek(self._running(tape, kind)) for kind in kinds}
        self._ends_early = tape.ends_early
        self.num_compared = 0
        self.num_left_out = 0
        self.num_beyond = 0  # computed, and not recorded where the recording was cut off
        self._longer: set[int] = set()  # the tracks of those
        self.mismatches: list[Mismatch] = []

    def compare(self, computed: Message) -> None:
        """Compare with the one of its kind, frame and fish."""
        if _track_of(computed) in self._leave_out:
            self.num_left_out += 1
            return
        self.num_compared += 1
        if isinstance(computed, LengthEstimate) and computed.is_final:
            self._early[computed.track_id] = computed
            return
        expected = self._expected[type(computed)]
        while (logged := expected.value) is not None and _comes_before(logged, computed):
            self._miss(logged)
            expected.step()
        if logged is None or not _is_of_same(logged, computed):
            self._have_one_more(computed)
            return
        expected.step()
        self._compare(logged, computed)

    def finish(self) -> None:
        """What was recorded and not computed is missing."""
        for rest in self._expected.values():
            while rest.value is not None:
                self._miss(rest.value)
                rest.step()
        for track_id, computed in self._early.items():
            logged = self._final.pop(track_id, None)
            if logged is None or track_id in self._longer:
                self._have_one_more(computed)
            else:
                self._compare(logged, computed)
        for logged in self._final.values():
            self._miss(logged)

    def _running(self, tape: Tape, kind: type[Message]) -> Iterator[Message]:
        """What is recorded of a kind, final lengths put aside."""
        for message in tape.messages(kind, keep=False):
            if _track_of(message) in self._leave_out:
                continue
            if isinstance(message, LengthEstimate) and message.is_final:
                self._final[message.track_id] = message
            else:
                yield message

    def _compare(self, logged: Message, computed: Message) -> None:
        for difference in differences(logged, computed):
            self._note(computed, difference)

    def _miss(self, logged: Message) -> None:
        self._note(logged, Difference("message", "one", "none"))

    def _have_one_more(self, computed: Message) -> None:
        if self._ends_early:
            self.num_beyond += 1
            self._longer.add(_track_of(computed))
        else:
            self._note(computed, Difference("message", "none", "one more"))

    def _note(self, message: Message, difference: Difference) -> None:
        kind = type(message).__name__
        self.mismatches.append(Mismatch(message.frame_index, _track_of(message), kind, difference))


class _Peek:
    """An iterator whose next value can be looked at."""

    def __init__(self, values: Iterator[Message]) -> None:
        self._values = values
        self.value: Message | None = None
        self.step()

    def step(self) -> None:
        """Go on to the next value."""
        self.value = next(self._values, None)


def _track_of(message: Message) -> int:
    return getattr(message, "track_id", 0)


def _comes_before(logged: Message, computed: Message) -> bool:
    """Whether the computed one is beyond the logged one: of another fish, or of a later frame."""
    if logged.frame_index != computed.frame_index:
        return logged.frame_index < computed.frame_index
    return not _is_of_same(logged, computed)


def _is_of_same(logged: Message, computed: Message) -> bool:
    return logged.frame_index == computed.frame_index and _track_of(logged) == _track_of(computed)


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
