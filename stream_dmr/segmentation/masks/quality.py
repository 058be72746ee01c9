"""What can be said of a crop at a glance: cut off, blown out, blurred."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

_BLOWN = 250  # grey level of every channel: no skin is so bright
_BORDER_PX = 1  # a mask this near to the frame's edge touches it


def touches_border(extent: Float[np.ndarray, "4"] | None, *, shape: tuple[int, ...]) -> bool:
    """Whether a mask, by its box in the frame, reaches the frame's edge; an empty one does not."""
    if extent is None:
        return False
    height, width = shape
    x0, y0, x1, y1 = extent
    return bool(min(x0, y0, width - x1, height - y1) <= _BORDER_PX)


def glare(image: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> float:
    """The share of the mask where the sensor saw nothing but light; 0 for an empty one."""
    is_blown = cv2.inRange(image, np.full(3, _BLOWN), np.full(3, 255)) > 0
    return float(np.count_nonzero(is_blown & mask) / max(np.count_nonzero(mask), 1))


def sharpness(image: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> float:
    """Variance of the Laplacian inside the mask (Pech-Pacheco et al., ICPR 2000)."""
    if not mask.any():
        return 0.0
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_64F)[mask].var())
