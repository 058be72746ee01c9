"""Masks of the fish: U2-Net's on pictures without the grid, corrected by hand."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from benchmarks.accuracy.chinook.grid import Grid, without_grid
from benchmarks.accuracy.chinook.photographs import Photograph
from benchmarks.segmentation.mask_proposer import MaskProposer, largest_shape

_SMOOTHING_PX = 5


def mask_of(photograph: Photograph, grid: Grid, proposer: MaskProposer) -> Bool[np.ndarray, "H W"]:
    """The mask of the one fish: the outline by hand, or the network's with its corrections."""
    mask = np.zeros(photograph.image.shape[:2], np.uint8)
    if photograph.outline is not None:
        cv2.fillPoly(mask, [photograph.outline], 1)
    elif proposed := proposer.propose(without_grid(photograph.image, grid), photograph.box):
        mask |= proposed.mask.astype(np.uint8)
    for polygon in photograph.removed:
        cv2.fillPoly(mask, [polygon], 0)
    for polygon in photograph.added:
        cv2.fillPoly(mask, [polygon], 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_SMOOTHING_PX, _SMOOTHING_PX))
    mask = cv2.morphologyEx(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disc), cv2.MORPH_OPEN, disc)
    fish = largest_shape(mask > 0)
    if fish is None:
        raise SystemExit(f"{photograph.name}: expected a fish in its box, found no mask")
    return fish


def open_proposer(path: Path) -> MaskProposer:
    """U2-Net from its file."""
    return MaskProposer(path)
