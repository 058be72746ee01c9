"""What became of a fish: landed, dropped or cut off, by where its body was last seen."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.catch.zones import ZonesSettings, shares_in
from stream_dmr.messages import LocalizedFish
from stream_dmr.reasons import Reason

UNKNOWN_FATE = "unknown"
_POINTS_OF_BODY = 33  # chosen: shares to 3 %


class Fate(NamedTuple):
    """What became of a fish, and how much of its body says so."""

    name: str  # "landed", "dropped", "cut off" or "unknown"
    share: float | None  # of the body in that zone, 0 to 1; None: its end was not seen


class FateTracker:
    """Takes the frames of one fish, in order."""

    def __init__(
        self, settings: ZonesSettings, *, frame_size: tuple[int, int] | None = None
    ) -> None:
        """`frame_size`: width and height, px; what the fit has beyond it counts as at its edge."""
        self._settings = settings
        self._limit = None if frame_size is None else np.array(frame_size, float) - 1
        self._seen: LocalizedFish | None = None  # the last frame in which its body was fitted
        self._is_hidden = False
        self._last_ns = 0

    def add(self, fish: LocalizedFish) -> None:
        """Take the next frame."""
        self._last_ns = fish.timestamp_ns
        self._is_hidden = fish.reason in (Reason.MOSTLY_HIDDEN,)
        if fish.keypoints_px is not None and np.isfinite(fish.keypoints_px).all():
            self._seen = fish

    def finish(self, *, watched_from_ns: int, watched_to_ns: int) -> Fate:
        """The fate, once the track has ended; frames were watched between these capture times.

        Unknown where the end was not seen: the fish was hidden, was still in view at the last
        frame, or was seen only before the first one, in a run that broke off.
        """
        gap_ns = round(self._settings.max_gap_s * 1e9)
        seen = self._seen
        if (
            seen is None
            or seen.keypoints_px is None
            or self._is_hidden
            or self._last_ns - seen.timestamp_ns > gap_ns
            or watched_to_ns - self._last_ns <= gap_ns
            or self._last_ns < watched_from_ns
        ):
            return Fate(UNKNOWN_FATE, None)
        shares = shares_in(self._settings, self._in_frame(body_points(seen.keypoints_px)))
        name = max(shares, key=lambda zone: shares[zone])
        is_sure = shares[name] >= self._settings.min_share
        return Fate(name if is_sure else UNKNOWN_FATE, shares[name])

    def _in_frame(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        return points if self._limit is None else points.clip(0, self._limit)


def body_points(keypoints_px: Float[np.ndarray, "3 2"]) -> Float[np.ndarray, "N 2"]:
    """Points along a body from head over center to tail, evenly in each half."""
    at = np.linspace(0, 2, _POINTS_OF_BODY)
    return np.stack([np.interp(at, [0, 1, 2], keypoints_px[:, axis]) for axis in (0, 1)], axis=1)
