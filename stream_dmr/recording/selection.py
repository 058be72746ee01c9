"""The part of a recording that is read: some time, some tracks, or all of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

Spans = Mapping[int, tuple[int, int]]
"""Track id -> capture times of its first and last message, ns."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Messages of a time span and of some tracks, and the frames in which these were seen."""

    time_ns: tuple[int, int] | None = None  # capture times: first (included), last (excluded)
    tracks: frozenset[int] | None = None
    lead_ns: int = 0  # so much time before `time_ns` as well

    @classmethod
    def from_seconds(
        cls, time_s: tuple[float, float] | None, tracks: frozenset[int] | None = None
    ) -> "Selection":
        """A selection by capture times in seconds, first (included) and last (excluded)."""
        time_ns = None if time_s is None else (round(time_s[0] * 1e9), round(time_s[1] * 1e9))
        return cls(time_ns=time_ns, tracks=tracks)

    @property
    def is_everything(self) -> bool:
        return self.time_ns is None and self.tracks is None

    def shifted(self, offset_ns: int) -> "Selection":
        """Its time on another clock, which is ahead by so much, of all tracks."""
        time_ns = None
        if self.time_ns is not None:
            time_ns = self.time_ns[0] + offset_ns, self.time_ns[1] + offset_ns
        return Selection(time_ns=time_ns)

    def includes_time(self, timestamp_ns: int) -> bool:
        return self.overlaps(timestamp_ns, timestamp_ns)

    def overlaps(self, first_ns: int, last_ns: int) -> bool:
        """True if a time from the first to the last, both included, may be selected."""
        if self.time_ns is None:
            return True
        begin_ns, end_ns = self.time_ns  # without the last
        return begin_ns - self.lead_ns <= last_ns and first_ns < end_ns

    def includes(self, message: object) -> bool:
        """True for a message of a selected track, and for every frame."""
        track_id = getattr(message, "track_id", None)
        return self.tracks is None or track_id is None or track_id in self.tracks

    def narrowed_to(self, spans: Spans | None) -> "Selection":
        """The same selection with no more time than its tracks span; None, not known: as it is."""
        if self.tracks is None or spans is None:
            return self
        seen = [spans[track_id] for track_id in self.tracks if track_id in spans]
        first = min((span[0] for span in seen), default=0)
        last = max((span[1] for span in seen), default=-1) + 1
        if self.time_ns is not None:
            first, last = max(first, self.time_ns[0]), min(last, self.time_ns[1])
        if not first < last:  # its tracks were not seen in its time, or not at all
            first = last = 0
        return replace(self, time_ns=(first, last))


EVERYTHING = Selection()
