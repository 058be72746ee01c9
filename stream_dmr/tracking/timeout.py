"""End tracks with given ids after nobody saw them for a while."""

from collections.abc import Iterable


class TrackTimeout:
    """The open tracks, in the order in which they were first seen."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_ns = round(timeout_s * 1e9)
        self._last_ns: dict[int, int] = {}

    @property
    def open_ids(self) -> list[int]:
        """The ids that have not ended."""
        return [*self._last_ns]

    def step(self, timestamp_ns: int, seen: Iterable[int]) -> list[int]:
        """Take the ids of a frame; return the ids that were unseen for longer than the timeout."""
        self._last_ns.update(dict.fromkeys(seen, timestamp_ns))
        earliest_ns = timestamp_ns - self._timeout_ns
        ended = [number for number, last_ns in self._last_ns.items() if last_ns < earliest_ns]
        for number in ended:
            del self._last_ns[number]
        return ended
