"""The interface of a detector: a frame in, candidates for fish out; the tracker identifies them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.messages import Frame


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidate:
    """A possible fish in one frame."""

    bbox_xyxy_px: Float[np.ndarray, "4"]  # half-open, frame pixels, inside the frame
    score: float  # 0 to 1
    # Silhouette within `whole_pixels` of the box; None from a detector of boxes alone.
    foreground: Bool[np.ndarray, "h w"] | None = None
    # Middle of the box, x and y in px of a view that does not move with the camera. It counts as a
    # fish once it has moved there; None: it need not move, since somebody found it.
    place_px: Float[np.ndarray, "2"] | None = None
    looks: float | None = None  # how much it looks like a fish, 0 to 1; None: nothing judged that


@runtime_checkable
class Detector(Protocol):
    """Finds candidates in consecutive frames; it may learn from earlier frames."""

    def find(self, frame: Frame) -> Sequence[Candidate]:
        """The candidates of one frame, in no particular order."""
        ...

    @property
    def refused(self) -> Mapping[str, int]:
        """How many shapes of all frames were no candidates, by reason with its setting."""
        ...
