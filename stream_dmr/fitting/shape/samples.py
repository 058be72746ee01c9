"""Frames of fish from which shapes are learnt: a few of each, whole, far apart in time."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from stream_dmr.messages import FishCrop

FRAMES_PER_FISH = 4  # far apart: more of one passage say little that is new
_TRIED_PER_FISH = 8  # frames of which the best fitted are taken; chosen
MAX_FISH = 60  # a stock's mean is known to an eighth of its individuals' spread, then
# Of a frame; chosen so that only masks of whole fish are learnt from.
_MIN_VISIBLE = 0.99
_MIN_CONFIDENCE = 0.52  # of a mask that was found

T = TypeVar("T")


@dataclass(eq=False)
class Sample:
    """One frame of a fish with the pose in which it was fitted."""

    crop: FishCrop  # without its picture
    pose: Float[np.ndarray, "P"]


@dataclass(eq=False)
class FishSamples:
    """The chosen frames of one fish, in order."""

    track_id: int
    candidate: int  # the shape that it was fitted with
    samples: list[Sample]
    against: Float[np.ndarray, "N"]  # nats that its masks say against each shape there is


@dataclass
class GoodCrops:
    """Crops of one fish that show it whole, evenly over all of them; memory is bounded."""

    _stride: int = 1  # every how many good crops one is kept
    _num_good: int = 0
    _kept: list[FishCrop] = field(default_factory=list)

    def add(self, crop: FishCrop) -> None:
        """Take the next crop of the fish; its picture is not kept."""
        if not _is_good(crop):
            return
        if self._num_good % self._stride == 0:
            self._kept.append(replace(crop, image=None))
        self._num_good += 1
        if len(self._kept) > 2 * _TRIED_PER_FISH:
            self._kept, self._stride = self._kept[::2], 2 * self._stride

    def chosen(self) -> list[FishCrop]:
        """A few that are far apart; none where the fish was never seen whole."""
        return evenly(self._kept, _TRIED_PER_FISH)


def good_crops(crops: Iterable[FishCrop]) -> list[list[FishCrop]]:
    """An even choice of fish, and of each one's crops that show it whole."""
    tracks: dict[int, GoodCrops] = {}
    for crop in crops:
        tracks.setdefault(crop.track_id, GoodCrops()).add(crop)
    seen_whole = {
        track_id: chosen for track_id in sorted(tracks) if (chosen := tracks[track_id].chosen())
    }
    return evenly([*seen_whole.values()], MAX_FISH)


def evenly(items: Sequence[T], most: int) -> list[T]:
    """At most so many items, evenly over all of them, first and last among them."""
    places = np.linspace(0, len(items) - 1, min(len(items), most)).round().astype(int)
    return [items[place] for place in np.unique(places)]


def _is_good(crop: FishCrop) -> bool:
    quality = crop.quality
    is_sure = quality.mask_confidence is None or quality.mask_confidence >= _MIN_CONFIDENCE
    return is_sure and not quality.touches_border and quality.visible_fraction >= _MIN_VISIBLE
