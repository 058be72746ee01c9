"""What turns a box into a mask: one small interface, asked on the crop, not on the frame.

A crop is already free of lens distortion, and its pixel map to the frame is in one place
(`crop.frame_from_crop_map`); a segmenter therefore knows nothing of cameras.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.messages import FishEnds


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Segmented:
    """The fish that a box means, as a segmenter sees it."""

    probability: Float32[np.ndarray, "S S"]  # of being fish, 0 to 1, at the crop's pixels
    ends: FishEnds | None  # None from a segmenter that doesn't look for them


@runtime_checkable
class Segmenter(Protocol):
    """A box in, a mask out."""

    def segment(
        self, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> Segmented:
        """The fish in a box, half-open in pixels of the crop `image` (BGR)."""
        ...
