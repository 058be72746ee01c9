"""SmoothLength: from the lengths of frames to the length of a fish.

Last of the chain: LocalizedFish -> LengthEstimate, one running estimate for every frame of a fish
and a final one when its track ends.
"""

from collections.abc import Sequence

from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.lengths.track_length import TrackLength, late_estimate
from stream_dmr.messages import LengthEstimate, LocalizedFish


class SmoothLength:
    """Holds the open tracks. Each id gets one final estimate, ever: ids are not used again.

    A fish that returns under its old id after its track has ended is refused with that reason,
    so that no table gets a second row for it.
    """

    def __init__(self, settings: SmoothLengthSettings) -> None:
        self._settings = settings
        self._open: dict[int, TrackLength] = {}
        self._ended: set[int] = set()

    def step(self, message: LocalizedFish, /) -> Sequence[LengthEstimate]:
        """Return the running estimate of this fish after one more frame."""
        if message.track_id in self._ended:
            return [late_estimate(message)]
        if message.track_id not in self._open:
            self._open[message.track_id] = TrackLength(message, self._settings)
        return [self._open[message.track_id].add(message)]

    def tick(self, timestamp_ns: int, /) -> Sequence[LengthEstimate]:
        """Finish the tracks unseen for `track_timeout_s` at this capture time."""
        earliest_ns = timestamp_ns - round(self._settings.track_timeout_s * 1e9)
        overdue = [i for i, track in self._open.items() if track.last_timestamp_ns < earliest_ns]
        return [self._finish(track_id) for track_id in overdue]

    def close(self) -> Sequence[LengthEstimate]:
        """Finish all tracks still open."""
        return [self._finish(track_id) for track_id in list(self._open)]

    def _finish(self, track_id: int) -> LengthEstimate:
        self._ended.add(track_id)
        return self._open.pop(track_id).finish()
