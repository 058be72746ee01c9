"""Squares of annotated pictures in which no box is: water, plants and walls without fish."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

Image = UInt8[np.ndarray, "H W 3"]

_MIN_SIDE = 0.35  # of the picture's shorter side
_MARGIN_PX = 4  # to the boxes, which are not exact


def largest_empty_square(
    image: Image, boxes: list[Float[np.ndarray, "4"]]
) -> UInt8[np.ndarray, "S S 3"] | None:
    """The largest square without a box; None where it is small. Boxes: left, top, right, bottom."""
    height, width = image.shape[:2]
    free = np.zeros((height + 2, width + 2), np.uint8)  # with a rim that is not free
    free[1:-1, 1:-1] = 1
    for box in boxes:
        x0, y0 = np.maximum(np.floor(box[:2]).astype(int) - _MARGIN_PX + 1, 0)
        x1, y1 = np.ceil(box[2:]).astype(int) + _MARGIN_PX + 1
        free[y0:y1, x0:x1] = 0
    # The largest distance of the chessboard is half the side of the largest square.
    distance = cv2.distanceTransform(free, cv2.DIST_C, 3)
    y, x = np.unravel_index(int(distance.argmax()), distance.shape)
    half = int(distance[y, x]) - 1
    if 2 * half < _MIN_SIDE * min(height, width):
        return None
    row, column = int(y) - 1, int(x) - 1
    return image[row - half : row + half + 1, column - half : column + half + 1]
