"""Quality of a crop: cut off by the frame, overexposed, blurred."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

_OVEREXPOSED_LEVEL = 250  # grey level of every channel; brighter than any skin in our scenes


def touches_border(
    extent: Float[np.ndarray, "4"] | None, *, shape: tuple[int, ...], pixel_px: float = 1.0
) -> bool:
    """True where a mask is within a pixel of the edge of a frame of shape (H, W); None: False.

    `extent`: the half-open box of the frame pixels with the centers of the mask's pixels, which are
    `pixel_px` frame pixels wide: the mask goes half of one further. In a picture of 12 megapixels a
    crop's pixel has 40.
    """
    if extent is None:
        return False
    height, width = shape
    x0, y0, x1, y1 = extent
    return bool(min(x0, y0, width - x1, height - y1) <= 1.5 * max(pixel_px, 1.0) - 0.5)


def glare(image: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> float:
    """The fraction of the mask that is overexposed, 0 to 1; 0 for an empty mask."""
    is_overexposed = cv2.inRange(image, np.full(3, _OVEREXPOSED_LEVEL), np.full(3, 255)) > 0
    return float(np.count_nonzero(is_overexposed & mask) / max(np.count_nonzero(mask), 1))


def sharpness(image: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> float:
    """Variance of the Laplacian inside the mask, squared grey levels; 0 for an empty mask.

    After Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
    """
    if not mask.any():
        return 0.0
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_64F)[mask].var())
