"""Zones of the picture that say what became of the fish whose tracks end in them."""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator

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
        default=[], description="of the one in which fish fall off the hook, frame px"
    )
    cut_off: Points = Field(
        default=[], description="of the one in which lines are cut with the fish on them, frame px"
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
        description="a fish that was hidden, or not fitted, for longer before its track ended has "
        "an unknown fate; so has one in view within this time of the end, s",
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
    """The share of `points` in each zone, by its fate; where zones overlap, the first has them."""
    is_left, shares = np.ones(len(points), bool), dict[str, float]()
    for name, corners in settings.polygons():
        inside = [_is_inside(corners, point) for point in points]
        shares[name] = float(np.mean(inside & is_left))
        is_left &= ~np.array(inside)
    return shares


def _is_inside(corners: Float[np.ndarray, "N 2"], point: Float[np.ndarray, "2"]) -> bool:
    x, y = float(point[0]), float(point[1])
    return cv2.pointPolygonTest(corners.astype(np.float32), (x, y), False) >= 0
