"""When a track becomes a fish: seen long enough, and inside the zone where fish are counted."""

from typing import Annotated

from pydantic import Field, field_validator

from stream_dmr.segmentation.tracking import Sighting
from stream_dmr.settings import Settings

Fraction = Annotated[float, Field(ge=0, le=1)]


class CounterSettings(Settings):
    """The part of `[track_fish]` that says which tracks count as fish; each counts once."""

    min_track_frames: int = Field(
        default=4, ge=1, description="frames in which a fish is seen before it counts"
    )
    zone: list[Fraction] = Field(
        default=[0.0, 0.0, 1.0, 1.0],
        min_length=4,
        max_length=4,
        description="left, top, right, bottom of where fish count, as fractions of the picture",
    )

    @field_validator("zone")
    @classmethod
    def _has_an_inside(cls, zone: list[float]) -> list[float]:
        left, top, right, bottom = zone
        if not (left < right and top < bottom):
            raise ValueError("left, top, right, bottom with left < right and top < bottom")
        return zone


class FishCounter:
    """Gives fish their ids, from 1, in the order in which they come to count; never one again."""

    def __init__(self, settings: CounterSettings) -> None:
        self._settings = settings
        self._ids: dict[int, int] = {}  # of tracks by their number
        self.count = 0

    def track_id(self, sighting: Sighting, *, width: int, height: int) -> int | None:
        """The id of the fish that a track is, in a picture of that size; None while it is none.

        A fish that has been counted keeps its id outside the zone.
        """
        known = self._ids.get(sighting.number)
        if known is not None or not self._counts(sighting, width=width, height=height):
            return known
        self.count += 1
        self._ids[sighting.number] = self.count
        return self.count

    def _counts(self, sighting: Sighting, *, width: int, height: int) -> bool:
        x0, y0, x1, y1 = sighting.candidate.bbox_xyxy_px.tolist()
        left, top, right, bottom = self._settings.zone
        is_beside = left * width <= (x0 + x1) / 2 <= right * width
        is_level = top * height <= (y0 + y1) / 2 <= bottom * height
        return is_beside and is_level and sighting.frames_seen >= self._settings.min_track_frames
