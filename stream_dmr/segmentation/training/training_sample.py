"""One training example: a crop with its true mask."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingSample:
    """A crop with its true mask and ends, at the network's input size."""

    image: UInt8[np.ndarray, "S S 3"]  # BGR
    mask: Float32[np.ndarray, "S S"]  # fraction of each pixel that is fish, 0 to 1
    in_box: Float32[np.ndarray, "S S"]  # see `box_coverage`; all 1: the mask is of all fish
    ends_px: Float32[np.ndarray, "2 2"] | None  # head and tail, may lie outside; None: unknown
