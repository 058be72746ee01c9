"""Zones of the picture, fates and conditions of fish.

The condition codes are those of the regional observers of SPC and FFA, which WCPFC takes for
discards; the fields of longline forms are compared in WCPFC-SC9-2013/EB-WP-04, Appendix 1. They
were compared with the codes in public code that reads SPC's observer data, not with the paper.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator

from stream_dmr.messages import LocalizedFish, TrackEnded
from stream_dmr.reasons import Reason
from stream_dmr.settings import Settings

Points = list[list[float]]
FATE_OF_ZONE = {"landed": "landed", "dropped": "dropped", "cut_off": "cut off"}
"""Each zone by its key in config.toml, with what it says of a fish."""


class ZonesSettings(Settings):
    """`[zones]`: what became of a fish, by where its track ends."""

    landed: Points = Field(
        default=[],
        description="corners [x, y] of the polygon in which fish come aboard, frame px; []: none. "
        "Without any zone fates are not asked for",
    )
    dropped: Points = Field(
        default=[], description="corners of the polygon in which fish fall off the hook, frame px"
    )
    cut_off: Points = Field(
        default=[], description="corners of that in which lines are cut with fish on them, frame px"
    )
    min_share: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="least share of the body that lies in a zone when it is last seen; below it "
        "the fate is unknown",
    )
    max_gap_s: float = Field(
        default=0.5,
        ge=0,
        description="a fish that was not fitted for longer before its track ended has an unknown "
        "fate; so has one in view within this time of the end, s",
    )

    @field_validator(*FATE_OF_ZONE)
    @classmethod
    def _is_polygon(cls, points: Points) -> Points:
        if points and (len(points) < 3 or any(len(point) != 2 for point in points)):
            raise ValueError("three or more corners [x, y]")
        if points and cv2.contourArea(np.array(points, np.float32)) < 1:
            raise ValueError("corners around an area")
        return points

    def polygons(self) -> Iterator[tuple[str, Float[np.ndarray, "N 2"]]]:
        """The fates that have a zone, and its corners."""
        for key, fate in FATE_OF_ZONE.items():
            if points := getattr(self, key):
                yield fate, np.array(points, float)


def shares_in(settings: ZonesSettings, points: Float[np.ndarray, "N 2"]) -> dict[str, float]:
    """The share of `points` in each zone, by its fate; if zones overlap, the first counts."""
    is_left, shares = np.ones(len(points), bool), dict[str, float]()
    for name, corners in settings.polygons():
        polygon = corners.astype(np.float32)
        inside = [cv2.pointPolygonTest(polygon, (x, y), False) >= 0 for x, y in points.tolist()]
        shares[name] = float(np.mean(inside & is_left))
        is_left &= ~np.array(inside)
    return shares


UNKNOWN_FATE = "unknown"
_POINTS_OF_BODY = 33  # chosen: shares to 3 %


class Fate(NamedTuple):
    """What became of a fish, and the share of its body in that zone."""

    name: str  # "landed", "dropped", "cut off" or "unknown"
    share: float | None  # of the body in that zone, 0 to 1; None: its end was not seen


class FateTracker:
    """Takes the frames of one fish, in order."""

    def __init__(
        self, settings: ZonesSettings, *, frame_size: tuple[int, int] | None = None
    ) -> None:
        """`frame_size`: width and height, px; points of the fit beyond it count as at its edge."""
        self._settings = settings
        self._limit = None if frame_size is None else np.array(frame_size, float) - 1
        self._seen: LocalizedFish | None = None  # the last frame in which its body was fitted
        self._is_hidden = False
        self._last_ns = 0

    def add(self, fish: LocalizedFish) -> None:
        self._last_ns = fish.timestamp_ns
        self._is_hidden = fish.reason in (Reason.MOSTLY_HIDDEN,)
        if fish.keypoints_px is not None and np.isfinite(fish.keypoints_px).all():
            self._seen = fish

    def finish(self, ended: TrackEnded) -> Fate:
        """The fate, once the track has ended.

        Unknown if the end was not seen: the fish was hidden, or still in view at the last frame.
        """
        gap_ns = round(self._settings.max_gap_s * 1e9)
        seen = self._seen
        if (
            seen is None
            or seen.keypoints_px is None
            or self._is_hidden
            or self._last_ns - seen.timestamp_ns > gap_ns
            or ended.cause == "restart"
            or (ended.cause in ("end", "pause") and ended.timestamp_ns - self._last_ns <= gap_ns)
        ):
            return Fate(UNKNOWN_FATE, None)
        points = body_points(seen.keypoints_px)
        shares = shares_in(
            self._settings, points if self._limit is None else points.clip(0, self._limit)
        )
        name = max(shares, key=lambda zone: shares[zone])
        is_sure = shares[name] >= self._settings.min_share
        return Fate(name if is_sure else UNKNOWN_FATE, shares[name])


def body_points(keypoints_px: Float[np.ndarray, "3 2"]) -> Float[np.ndarray, "N 2"]:
    """Points along a body from head over center to tail, evenly in each half."""
    at = np.linspace(0, 2, _POINTS_OF_BODY)
    return np.stack([np.interp(at, [0, 1, 2], keypoints_px[:, axis]) for axis in (0, 1)], axis=1)


CONDITIONS: dict[str, str] = {
    "A0": "alive, not described further",
    "A1": "alive and healthy",
    "A2": "alive, injured or distressed",
    "A3": "alive, unlikely to live",
    "D": "dead",
    "U": "unknown",
}
FATES = (*FATE_OF_ZONE.values(), UNKNOWN_FATE)
