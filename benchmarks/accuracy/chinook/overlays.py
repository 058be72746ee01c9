"""Pictures to look at: the grid, the mask and the hand's points on each photograph."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from benchmarks.accuracy.chinook.grid import Grid, grid_lines
from benchmarks.accuracy.chinook.photographs import Photograph

_RED, _GREEN, _YELLOW = (0, 0, 255), (0, 255, 0), (0, 255, 255)


def draw_overlay(
    photograph: Photograph, grid: Grid, mask: Bool[np.ndarray, "H W"], path: Path
) -> None:
    """Write the photograph with its grid (red), mask (green), snout and fork (yellow)."""
    picture = photograph.image.copy()
    for line in grid_lines(grid, margin=1):
        cv2.polylines(picture, [np.round(line).astype(np.int32)], False, _RED, 1)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, _GREEN, 1)
    for point in (photograph.snout, photograph.fork):
        x, y = np.round(point).astype(int).tolist()
        cv2.drawMarker(picture, (x, y), _YELLOW, cv2.MARKER_CROSS, 12, 1)
    cv2.imwrite(str(path), picture)
