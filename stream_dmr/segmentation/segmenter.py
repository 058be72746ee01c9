"""The interface of a segmenter: an image and a box in, a mask out.

A segmenter sees a picture of the crop, not the frame. A crop is free of lens distortion, and its
pixel map to the frame is in one place (`crop_geometry`), so that a segmenter needs no camera.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.messages import FishEnds


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SegmentedFish:
    """The fish that a box encloses, as found by a segmenter."""

    probability: Float32[np.ndarray, "S S"]  # of each crop pixel to be fish, 0 to 1
    ends: FishEnds | None  # None from a segmenter that does not locate them

    def resized(self, size_px: int) -> "SegmentedFish":
        """The same fish in a crop of another size; pixel edges keep their places."""
        scale, ends = size_px / len(self.probability), self.ends
        if ends is not None:
            head_px, tail_px = ((p + 0.5) * scale - 0.5 for p in (ends.head_px, ends.tail_px))
            ends = FishEnds(head_px=head_px, tail_px=tail_px, confidence=ends.confidence)
        return SegmentedFish(
            probability=np.clip(resize(self.probability, size_px), 0, 1), ends=ends
        )


def resize(picture: np.ndarray, size_px: int) -> np.ndarray:
    """A square picture in another size; pixel edges keep their places, pixel centers don't."""
    if len(picture) == size_px:
        return picture
    interpolation = cv2.INTER_AREA if len(picture) > size_px else cv2.INTER_LINEAR
    return cv2.resize(picture, (size_px, size_px), interpolation=interpolation)


@runtime_checkable
class Segmenter(Protocol):
    """Finds the mask of the fish in a box."""

    @property
    def knows_fish(self) -> bool:
        """True if only fish get a mask; False if anything in the box gets a mask."""
        ...

    def segment(
        self, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> SegmentedFish:
        """The fish in a box, half-open in pixels of the crop `image` (BGR)."""
        ...


# The fish in a box, half-open in pixels of a crop (BGR).
Segment = Callable[[UInt8[np.ndarray, "S S 3"], Float[np.ndarray, "4"]], SegmentedFish]
# Turns of x, y, as np.rot90 turns a picture: by none, one, two and three quarters.
_TURNS = [np.linalg.matrix_power([[0, 1], [-1, 0]], number) for number in range(4)]


def segment_upright_as_well(
    segment: Segment, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
) -> SegmentedFish:
    """The fish in a box; if its head is not up, without what is no fish with the head up.

    A network that learnt lines above fish takes a line to any other side for a part of them, as in
    the pictures of a turned camera (docs/research/raw-video.md).
    """
    found = segment(image, bbox_xyxy_px)
    if found.ends is None:
        return found
    head_xy = found.ends.head_px - found.ends.tail_px
    number = int(np.argmin([(turn @ head_xy)[1] for turn in _TURNS]))
    if number == 0:
        return found
    turn, size = _TURNS[number], len(image)
    corners = (bbox_xyxy_px.reshape(2, 2) - size / 2) @ turn.T + size / 2
    box = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
    upright = segment(np.ascontiguousarray(np.rot90(image, number)), box)
    other = np.rot90(upright.probability, -number)
    probability = np.where(other < 0.5, np.minimum(found.probability, other), found.probability)
    ends, middle = upright.ends, (size - 1) / 2
    if ends is not None:
        head_px, tail_px = ((p - middle) @ turn + middle for p in (ends.head_px, ends.tail_px))
        ends = replace(ends, head_px=head_px, tail_px=tail_px)
    return SegmentedFish(probability=probability, ends=ends)


def segment_both_ways(
    segment: Segment, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
) -> SegmentedFish:
    """The fish in a box, with the mean probability of the image and of the mirrored one.

    Mirrored images are segmented a little differently, so the mean is better
    (docs/research/real-pictures.md).
    """
    found = segment(image, bbox_xyxy_px)
    x0, y0, x1, y1 = bbox_xyxy_px
    box = np.array([len(image) - x1, y0, len(image) - x0, y1])
    mirrored = segment(np.ascontiguousarray(image[:, ::-1]), box)
    return replace(found, probability=(found.probability + mirrored.probability[:, ::-1]) / 2)
