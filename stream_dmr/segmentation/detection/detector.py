"""What a detector is: it says where fish may be in a picture; who is who is the tracker's part."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.messages import Frame


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidate:
    """Something in one frame that may be a fish."""

    bbox_xyxy_px: Float[np.ndarray, "4"]  # half-open, frame pixels, inside the frame
    score: float  # 0 to 1
    # What the detector takes for fish, from the box's corner on, rounded to whole pixels.
    foreground: Bool[np.ndarray, "h w"] | None = None


@runtime_checkable
class Detector(Protocol):
    """Finds fish in consecutive frames; it may learn from those before."""

    def find(self, frame: Frame) -> Sequence[Candidate]:
        """The candidates of one frame, in no order that means anything."""
        ...


def whole_pixels(bbox_xyxy_px: Float[np.ndarray, "4"]) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 of the box rounded to pixel edges, at least one pixel wide and high."""
    x0, y0, x1, y1 = np.round(bbox_xyxy_px).astype(int).tolist()
    return x0, y0, max(x1, x0 + 1), max(y1, y0 + 1)
