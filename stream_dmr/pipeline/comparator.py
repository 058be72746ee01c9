"""Compare recomputed messages with recorded messages."""

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from stream_dmr.messages import LengthEstimate, Message, track_of
from stream_dmr.pipeline.session import RecordedMessages, SoughtMessages

UNREPEATABLE = {"elapsed_ns"}  # wall clock: the one field that no replay can repeat
_MAX_SHOWN = 60  # characters of a value, so that both fit in a line


class Difference(NamedTuple):
    """A field in which two messages differ."""

    field: str  # its path, such as "shape.losses.iou"
    recorded: str
    computed: str


def differences(recorded: object, computed: object, *, field: str = "") -> Iterator[Difference]:
    """Every field in which two values differ. Numbers are equal if their bits are, also NaN."""
    if is_dataclass(recorded) and type(recorded) is type(computed):
        for part in fields(recorded):
            if part.name not in UNREPEATABLE:
                yield from differences(
                    getattr(recorded, part.name),
                    getattr(computed, part.name),
                    field=f"{field}.{part.name}".lstrip("."),
                )
    elif not _is_same(recorded, computed):
        yield Difference(field, _shown(recorded, computed), _shown(computed, recorded))


def _is_same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("d", a) == struct.pack("d", b)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return dict(a) == dict(b)
    if isinstance(a, str) and isinstance(b, str):
        return a == b  # a Reason is its text
    return type(a) is type(b) and a == b


def _shown(value: object, other: object) -> str:
    """A value as one line; for arrays of equal shape the first entry that differs."""
    if isinstance(value, np.ndarray) and isinstance(other, np.ndarray):
        if value.shape != other.shape or value.dtype != other.dtype:
            return f"{value.dtype} array of shape {value.shape}"
        differs = np.atleast_1d(value).view(np.uint8) != np.atleast_1d(other).view(np.uint8)
        first = int(np.flatnonzero(differs.ravel())[0]) // value.itemsize
        entry = np.unravel_index(first, value.shape) if value.shape else ()
        count = np.count_nonzero(differs.reshape(-1, value.itemsize).any(axis=1))
        where = "".join(f"[{int(i)}]" for i in entry)
        return f"{where} {value.ravel()[first]!r} ({count} of {value.size} differ)"
    text = repr(str(value) if isinstance(value, str) else value)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


class Mismatch(NamedTuple):
    """A field in which a recomputed message differs from the recorded message."""

    frame_index: int
    track_id: int
    kind: str
    difference: Difference


class MessageComparator:
    """Compares recomputed messages with recorded messages, type by type, frame by frame.

    Final lengths are compared by fish, whatever their frames: if a recording was cut off, or
    continues in another file, a track may end at another moment.
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
        self._expected = {kind: SoughtMessages(self._running(recorded, kind)) for kind in kinds}
        self._ends_early = recorded.ends_early
        self._tracks_beyond: set[int] = set()
        self.num_compared = 0
        self.num_left_out = 0
        self.num_beyond = 0  # computed, and not recorded since the recording was cut off
        self.mismatches: list[Mismatch] = []
        # Largest relative difference of a final length; infinite if one of two is missing.
        self.length_change = 0.0

    def compare(self, computed: Message) -> None:
        """Compare with the recorded message of the same frame and fish, if its type is compared."""
        expected = self._expected.get(type(computed))
        if expected is None:
            return
        if track_of(computed) in self._leave_out:
            self.num_left_out += 1
            return
        self.num_compared += 1
        if isinstance(computed, LengthEstimate) and computed.is_final:
            self._computed_final[computed.track_id] = computed
            return
        recorded = expected.take(computed.frame_index, track_of(computed))
        if recorded is None:
            self._add_surplus(computed)
        else:
            self._compare(recorded, computed)

    def finish(self) -> None:
        """Compare the final lengths, and add messages that were recorded and not computed."""
        for expected in self._expected.values():
            for recorded in expected.rest():
                self._add_missing(recorded)
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
        self.mismatches.sort(key=lambda mismatch: mismatch.frame_index)

    def _running(self, recorded: RecordedMessages, kind: type[Message]) -> Iterator[Message]:
        """The recorded messages of a type; final lengths are kept apart."""
        for message in recorded.of_type(kind, keep_payloads=False):
            if track_of(message) in self._leave_out:
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
            self._tracks_beyond.add(track_of(computed))
        else:
            self._add(computed, Difference("message", "none", "one more"))
            self.length_change = inf

    def _add(self, message: Message, difference: Difference) -> None:
        kind = type(message).__name__
        self.mismatches.append(Mismatch(message.frame_index, track_of(message), kind, difference))


def _length_change(recorded: LengthEstimate, computed: LengthEstimate) -> float:
    """Relative difference of two final lengths; infinite if status differs or one is missing."""
    before, now = recorded.length_mm, computed.length_mm
    if recorded.status != computed.status or (before is None) != (now is None):
        return inf
    return 0.0 if before is None or now is None else abs(now / before - 1)
