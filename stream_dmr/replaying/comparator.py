"""Compares the messages of a replay with the recorded ones."""

from collections.abc import Collection, Iterator, Sequence
from math import inf
from typing import NamedTuple

from stream_dmr.messages import LengthEstimate, Message
from stream_dmr.replaying.difference import Difference, differences
from stream_dmr.replaying.recorded_messages import RecordedMessages


class Mismatch(NamedTuple):
    """One field in which a recomputed message differs from the recorded one."""

    frame_index: int
    track_id: int
    kind: str
    difference: Difference


class MessageComparator:
    """Compares recomputed messages with recorded ones, type by type in the order of their frames.

    The final length of a fish is compared with the recorded one wherever that stands: where a
    recording was cut off, or goes on in another file, a track may end at another moment.
    """

    def __init__(
        self,
        recorded: RecordedMessages,
        kinds: Sequence[type[Message]],
        *,
        leave_out: Collection[int] = (),
    ) -> None:
        """`leave_out` are tracks that a replay of this recording can't repeat."""
        self._leave_out = leave_out
        self._recorded_final: dict[int, LengthEstimate] = {}  # by track, not computed yet
        self._computed_final: dict[int, LengthEstimate] = {}
        self._expected = {kind: _Lookahead(self._running(recorded, kind)) for kind in kinds}
        self._ends_early = recorded.ends_early
        self._tracks_beyond: set[int] = set()
        self.num_compared = 0
        self.num_left_out = 0
        self.num_beyond = 0  # computed, and not recorded since the recording was cut off
        self.mismatches: list[Mismatch] = []
        # Largest relative difference of a final length; infinite where one of two is missing.
        self.length_change = 0.0

    def compare(self, computed: Message) -> None:
        """Compare with the recorded message of the same type, frame and fish."""
        if _track_of(computed) in self._leave_out:
            self.num_left_out += 1
            return
        self.num_compared += 1
        if isinstance(computed, LengthEstimate) and computed.is_final:
            self._computed_final[computed.track_id] = computed
            return
        expected = self._expected[type(computed)]
        while (recorded := expected.value) is not None and _comes_before(recorded, computed):
            self._add_missing(recorded)
            expected.step()
        if recorded is None or not _is_of_same(recorded, computed):
            self._add_surplus(computed)
            return
        expected.step()
        self._compare(recorded, computed)

    def finish(self) -> None:
        """Compare the final lengths, and add what was recorded and not computed."""
        for rest in self._expected.values():
            while rest.value is not None:
                self._add_missing(rest.value)
                rest.step()
        for track_id, computed in self._computed_final.items():
            recorded = self._recorded_final.pop(track_id, None)
            if recorded is None or track_id in self._tracks_beyond:
                self._add_surplus(computed)
            else:
                self._compare(recorded, computed)
                change = _length_change(recorded, computed)
                self.length_change = max(self.length_change, change)
        for recorded in self._recorded_final.values():
            self._add_missing(recorded)

    def _running(self, recorded: RecordedMessages, kind: type[Message]) -> Iterator[Message]:
        """The recorded messages of a type; final lengths are kept apart."""
        for message in recorded.of_type(kind, keep_payloads=False):
            if _track_of(message) in self._leave_out:
                continue
            if isinstance(message, LengthEstimate) and message.is_final:
                self._recorded_final[message.track_id] = message
            else:
                yield message

    def _compare(self, recorded: Message, computed: Message) -> None:
        for difference in differences(recorded, computed):
            self._add(computed, difference)

    def _add_missing(self, recorded: Message) -> None:
        self._add(recorded, Difference("message", "one", "none"))
        self.length_change = inf

    def _add_surplus(self, computed: Message) -> None:
        if self._ends_early:
            self.num_beyond += 1
            self._tracks_beyond.add(_track_of(computed))
        else:
            self._add(computed, Difference("message", "none", "one more"))
            self.length_change = inf

    def _add(self, message: Message, difference: Difference) -> None:
        kind = type(message).__name__
        self.mismatches.append(Mismatch(message.frame_index, _track_of(message), kind, difference))


class _Lookahead:
    """An iterator whose next value can be looked at."""

    def __init__(self, values: Iterator[Message]) -> None:
        self._values = values
        self.value: Message | None = None
        self.step()

    def step(self) -> None:
        """Go to the next value."""
        self.value = next(self._values, None)


def _track_of(message: Message) -> int:
    return getattr(message, "track_id", 0)


def _comes_before(recorded: Message, computed: Message) -> bool:
    """True where the computed message is of a later frame, or of another fish in the same one."""
    if recorded.frame_index != computed.frame_index:
        return recorded.frame_index < computed.frame_index
    return not _is_of_same(recorded, computed)


def _is_of_same(recorded: Message, computed: Message) -> bool:
    is_same_frame = recorded.frame_index == computed.frame_index
    return is_same_frame and _track_of(recorded) == _track_of(computed)


def _length_change(recorded: LengthEstimate, computed: LengthEstimate) -> float:
    """Relative difference of two final lengths; infinite where their fish fared differently."""
    before, now = recorded.length_mm, computed.length_mm
    if recorded.status != computed.status or (before is None) != (now is None):
        return inf
    return 0.0 if before is None or now is None else abs(now / before - 1)
