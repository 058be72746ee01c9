"""Fish that a detector found twice in one picture, and parts of fish that it took for others.

A box with a fish's tail and one without it, or a fish and its fin, overlap too little to be one
box. Their masks tell: fish share no pixels.
"""

from collections.abc import Mapping

import cv2
import numpy as np

from stream_dmr.messages import FishCrop

# Of a mask that lies inside another one. In 70 stills, repeats and fins had 0.85 and more of theirs
# in the fish's, neighbours at most 0.14; see docs/research/real-lengths.md.
_SAME = 0.5


def without_repeats(crops: Mapping[int, FishCrop], scores: Mapping[int, float]) -> list[int]:
    """The ids of crops of one picture without those whose masks lie in one of a higher score."""
    kept: list[int] = []
    for one in sorted(crops, key=lambda one: -scores[one]):
        if all(share_inside(crops[one], crops[other]) <= _SAME for other in kept):
            kept.append(one)
    return sorted(kept)


def share_inside(crop: FishCrop, other: FishCrop) -> float:
    """The share of a crop's mask that lies in another crop's of the same frame; 0 if it is empty.

    Both cameras have the frame camera's orientation and no distortion.
    """
    crop_from_other = crop.crop_camera.K @ np.linalg.inv(other.crop_camera.K)
    seen = cv2.warpAffine(
        other.mask.view(np.uint8) * np.uint8(255), crop_from_other[:2], crop.mask.shape[::-1]
    )
    return np.count_nonzero(crop.mask & (seen > 127)) / max(np.count_nonzero(crop.mask), 1)
