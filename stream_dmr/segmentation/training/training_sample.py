"""One training example."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8


@dataclass(frozen=True, eq=False, kw_only=True)
class Sample:
    """A crop with the truth about it."""

    image: UInt8[np.ndarray, "S S 3"]  # BGR
    mask: Float32[np.ndarray, "S S"]  # how much of each pixel is fish, 0 to 1
    in_box: Float32[np.ndarray, "S S"]  # all 1: no box, every fish is wanted
    ends_px: Float32[np.ndarray, "2 2"] | None  # head and tail, perhaps outside; None: not known
