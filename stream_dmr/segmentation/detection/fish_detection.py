"""One fish in one frame, as detectors, trackers and annotation files hand it to the crop."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Detection:
    """One fish seen in one frame."""

    source_id: int  # of its annotation file or of the tracker, the same in each frame
    bbox_xyxy_px: Float[np.ndarray, "4"]  # half-open, frame pixels
    # Of the frame, or of a part with the whole fish; all False for an empty mask; None: the
    # segmenter is to find it.
    mask: Bool[np.ndarray, "h w"] | None
    visible_fraction: float  # 0 to 1
    mask_corner: tuple[int, int] = (0, 0)  # frame pixel (x, y) of the mask's top left one
    may_be_no_fish: bool = False  # found by a detector, and not yet known to be a fish
    # Pixels that something in front of fish hides: neither fish nor water; None: no such pixel.
    unknown: Bool[np.ndarray, "H W"] | None = None
