"""What is wanted of a recording: some time, some fish, or all of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

Spans = Mapping[int, tuple[int, int]]  # track id -> capture times of its first and last message, ns


@dataclass(frozen=True, kw_only=True)
class Part:
    """Messages within a time, of some tracks and of the frames in which these were seen."""

    time_ns: tuple[int, int] | None = None  # of capture: first (included), last (excluded)
    tracks: frozenset[int] | None = None
    lead_ns: int = 0  # so much time before it as well

    @classmethod
    def of_seconds(
        cls, time_s: tuple[float, float] | None, tracks: frozenset[int] | None = None
    ) -> "Part":
        """A part by capture times in seconds."""
        time_ns = None if time_s is None else (round(time_s[0] * 1e9), round(time_s[1] * 1e9))
        return cls(time_ns=time_ns, tracks=tracks)

    @property
    def is_whole(self) -> bool:
        """Whether nothing is left out."""
        return self.time_ns is None and self.tracks is None

    @property
    def bounds_ns(self) -> tuple[int | None, int | None]:
        """First capture time (included) and last one (excluded), None where there is no bound."""
        return (
            (None, None)
            if self.time_ns is None
            else (self.time_ns[0] - self.lead_ns, self.time_ns[1])
        )

    def has_time(self, timestamp_ns: int) -> bool:
        """Whether a capture time is wanted."""
        first, last = self.bounds_ns
        return (first is None or first <= timestamp_ns) and (last is None or timestamp_ns < last)

    def has(self, message: object) -> bool:
        """Whether the fish of a message is wanted; a frame always is."""
        track_id = getattr(message, "track_id", None)
        return self.tracks is None or track_id is None or track_id in self.tracks

    def within(self, spans: Spans) -> "Part":
        """The same part, with no more time than its tracks take; `spans` are empty if unknown."""
        if self.tracks is None or not spans:
            return self
        seen = [spans[track_id] for track_id in self.tracks if track_id in spans]
        first = min((span[0] for span in seen), default=0)
        last = max((span[1] for span in seen), default=-1) + 1
        if self.time_ns is not None:
            first, last = max(first, self.time_ns[0]), min(last, self.time_ns[1])
        return replace(self, time_ns=(first, last))


WHOLE = Part()
