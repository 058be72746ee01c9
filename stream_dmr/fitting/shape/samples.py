"""Frames of fish from which shapes are learnt: a few of each, whole, far apart in time."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from stream_dmr.messages import FishCrop

FRAMES_PER_FISH = 4  # far apart: more of one passage say little that is new
_TRIED_PER_FISH = 8  # frames of which the best fitted are taken; chosen
_MAX_FISH = 60  # a stock's mean is known to an eighth of its individuals' spread, then
# Of a frame; chosen so that only masks of whole fish are learnt from.
_MIN_VISIBLE = 0.99
_MIN_CONFIDENCE = 0.8  # of a mask that was found

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


@dataclass
class _GoodCrops:
    stride: int = 1  # every how many good crops one is kept
    num_good: int = 0
    kept: list[FishCrop] = field(default_factory=list)


def good_crops(crops: Iterable[FishCrop]) -> list[list[FishCrop]]:
    """An even choice of fish, and of each one's crops that show it whole; memory is bounded."""
    tracks: dict[int, _GoodCrops] = {}
    for crop in crops:
        if not _is_good(crop):
            continue
        track = tracks.setdefault(crop.track_id, _GoodCrops())
        if track.num_good % track.stride == 0:
            track.kept.append(replace(crop, image=None))
        track.num_good += 1
        if len(track.kept) > 2 * _TRIED_PER_FISH:
            track.kept, track.stride = track.kept[::2], 2 * track.stride
    ids = evenly(sorted(tracks), _MAX_FISH)
    return [evenly(tracks[track_id].kept, _TRIED_PER_FISH) for track_id in ids]


def evenly(items: Sequence[T], most: int) -> list[T]:
    """At most so many items, evenly over all of them, first and last among them."""
    places = np.linspace(0, len(items) - 1, min(len(items), most)).round().astype(int)
    return [items[place] for place in np.unique(places)]


def _is_good(crop: FishCrop) -> bool:
    quality = crop.quality
    is_sure = quality.mask_confidence is None or quality.mask_confidence >= _MIN_CONFIDENCE
    return is_sure and not quality.touches_border and quality.visible_fraction >= _MIN_VISIBLE
