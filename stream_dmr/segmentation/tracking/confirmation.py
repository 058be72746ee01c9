"""When a track becomes a fish: clearly seen long enough, and inside the zone of the count.

Whatever moves may be followed; that it is a fish, and no gaff or wave, its masks say.
"""

from collections import Counter
from typing import Annotated

from pydantic import Field, field_validator

from stream_dmr.messages import FishCrop
from stream_dmr.settings import Settings

_MOST_DOUBTFUL = 1000  # tracks that are no fish yet; a run of weeks has many that never are

Fraction = Annotated[float, Field(ge=0, le=1)]


class CounterSettings(Settings):
    """The part of `[track_fish]` that says which tracks count as fish; each counts once."""

    min_track_frames: int = Field(
        default=4, ge=1, description="frames in which a fish is clearly seen before it counts"
    )
    min_mask_confidence: float = Field(
        default=0.8, ge=0, le=1, description="mask_confidence from which on a fish is clearly seen"
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
        self._clearly_seen: Counter[int] = Counter()  # frames of those that don't count yet
        self.count = 0

    def track_id(self, crop: FishCrop) -> int | None:
        """The id of the fish that a track is, by its crop of a frame; None while it is none.

        A fish that has been counted keeps its id outside the zone.
        """
        number = crop.track_id
        if number not in self._ids:
            confidence = crop.quality.mask_confidence
            if confidence is None or confidence >= self._settings.min_mask_confidence:
                self._clearly_seen[number] += 1
                if len(self._clearly_seen) > _MOST_DOUBTFUL:
                    del self._clearly_seen[min(self._clearly_seen)]
            if not self._counts(crop):
                return None
            self.count += 1
            self._ids[number] = self.count
            del self._clearly_seen[number]
        return self._ids[number]

    def _counts(self, crop: FishCrop) -> bool:
        width, height = crop.frame_camera.width, crop.frame_camera.height
        x0, y0, x1, y1 = crop.bbox_xyxy_px.tolist()
        left, top, right, bottom = self._settings.zone
        is_beside = left * width <= (x0 + x1) / 2 <= right * width
        is_level = top * height <= (y0 + y1) / 2 <= bottom * height
        is_seen = self._clearly_seen[crop.track_id] >= self._settings.min_track_frames
        return is_beside and is_level and is_seen
