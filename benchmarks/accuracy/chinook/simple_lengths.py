"""Lengths in cells without a mesh: from two points by hand, and from the mask alone."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.accuracy.chinook.grid import Grid
from benchmarks.accuracy.chinook.photographs import Photograph
from benchmarks.table1.mask_midline import midline_of
from stream_dmr.geometry import arc_lengths


def by_hand(photograph: Photograph, grid: Grid) -> float:
    """From snout to fork, both marked by hand, straight."""
    ends = grid.in_cells(np.stack([photograph.snout, photograph.fork]))
    return float(np.linalg.norm(ends[1] - ends[0]))


def largest_diameter(mask: Bool[np.ndarray, "H W"], grid: Grid) -> float:
    """Between the two points of the mask's hull that are furthest apart: to the longer lobe."""
    hull = cv2.convexHull(_contour(mask)).reshape(-1, 2).astype(np.float64)
    cells = grid.in_cells(hull)
    return float(np.linalg.norm(cells[:, None] - cells[None], axis=2).max())


def midline(mask: Bool[np.ndarray, "H W"], grid: Grid) -> float:
    """Along the middle of the mask, from end to end; at the tail to the fork."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    side = max(width, height) + 8
    square = np.zeros((side, side), bool)
    square[4 : 4 + height, 4 : 4 + width] = mask[y : y + height, x : x + width]
    line = midline_of(square)
    if line is None:
        return float("nan")
    return float(arc_lengths(grid.in_cells(line + np.array([x - 4, y - 4])))[-1])


def _contour(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "N 1 2"]:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return max(contours, key=len)
