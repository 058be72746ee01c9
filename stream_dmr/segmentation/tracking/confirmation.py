"""Confirm a track as a fish once it was clearly segmented in enough frames inside the zone.

The tracker follows whatever moves. Gaffs and waves are distinguished from fish by their masks,
which are empty or of low confidence.
"""

from collections import Counter
from typing import Annotated

from pydantic import Field, field_validator

from stream_dmr.messages import FishCrop
from stream_dmr.settings import Settings

# Bounds the memory of a run of weeks; tracks live for seconds, so older ones have ended long ago.
_MAX_UNCONFIRMED_TRACKS = 1000
# After so many frames in a row whose masks show as good as nothing, a track is at another thing:
# the place where its fish was. Of simulated fish at most three frames in a row are unclear.
_MAX_EMPTY_FRAMES, _NOTHING = 5, 0.2

Fraction = Annotated[float, Field(ge=0, le=1)]


class ConfirmationSettings(Settings):
    """The part of `[track_fish]` that decides which tracks count as fish; each counts once."""

    min_track_frames: int = Field(
        default=4, ge=1, description="frames in which a fish is clearly seen before it counts"
    )
    min_fish_like_frames: int = Field(
        default=2,
        ge=0,
        description="frames in which what moves has to look like a fish to the network as well; "
        "0: motion and a mask are enough",
    )
    min_mask_confidence: float = Field(
        default=0.52, ge=0, le=1, description="mask_confidence from which on a fish is clearly seen"
    )
    zone: list[Fraction] = Field(
        default=[0.0, 0.0, 1.0, 1.0],
        min_length=4,
        max_length=4,
        description="left, top, right, bottom of where fish count, as fractions of the picture",
    )

    @field_validator("zone")
    @classmethod
    def _has_positive_area(cls, zone: list[float]) -> list[float]:
        left, top, right, bottom = zone
        if not (left < right and top < bottom):
            raise ValueError("left, top, right, bottom with left < right and top < bottom")
        return zone


class FishConfirmation:
    """Decides which tracks are fish; a confirmed one stays confirmed, and counts while seen."""

    def __init__(self, settings: ConfirmationSettings) -> None:
        self._settings = settings
        self._confirmed: set[int] = set()  # track numbers
        self._num_clear_frames: Counter[int] = Counter()  # of unconfirmed tracks
        self._num_empty_frames: Counter[int] = Counter()  # of confirmed ones, in a row

    def is_confirmed(self, number: int) -> bool:
        """True for a track that counts as a fish."""
        return number in self._confirmed

    def update(self, number: int, crop: FishCrop, *, may_count: bool = True) -> bool:
        """Take a track's crop of one frame into account; True for a confirmed fish that it shows.

        `may_count`: False while the other evidence doubts it. A confirmed fish remains one
        outside the zone. A crop without `mask_confidence` (a given mask) counts as clearly seen.
        """
        confidence = crop.quality.mask_confidence
        if number not in self._confirmed:
            if confidence is None or confidence >= self._settings.min_mask_confidence:
                self._num_clear_frames[number] += 1
                if len(self._num_clear_frames) > _MAX_UNCONFIRMED_TRACKS:
                    del self._num_clear_frames[min(self._num_clear_frames)]
            if not (may_count and self._is_confirmed_by(number, crop)):
                return False
            self._confirmed.add(number)
            del self._num_clear_frames[number]
        if confidence is None or confidence >= _NOTHING:
            self._num_empty_frames.pop(number, None)
        else:
            self._num_empty_frames[number] += 1
        return self._num_empty_frames[number] <= _MAX_EMPTY_FRAMES

    def _is_confirmed_by(self, number: int, crop: FishCrop) -> bool:
        width, height = crop.frame_camera.width, crop.frame_camera.height
        x0, y0, x1, y1 = crop.bbox_xyxy_px.tolist()
        left, top, right, bottom = self._settings.zone
        is_in_zone = (
            left * width <= (x0 + x1) / 2 <= right * width
            and top * height <= (y0 + y1) / 2 <= bottom * height
        )
        return is_in_zone and self._num_clear_frames[number] >= self._settings.min_track_frames
