"""Detect from a small grey picture whether anything happens in it.

Water moves all the time, more under wind, spray or a camera that sways. A change is therefore
measured twice against the scene itself: each cell of the picture against the usual change of that
cell, and the largest such change against the largest change of most pictures.
"""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

# Chosen on made clips of water, the shared scenes and real clips; see docs/research/raw-video.md.
_LONGER_PX = 160  # of the small picture, whose pixels are the cells
_MEAN_RATE, _CHANGE_RATE = 0.1, 0.05  # of learning a cell's brightness, and its usual change
_LEAST_CHANGE = 2.0  # grey levels; of cells that never change
_LIGHT_CELLS = 41  # a change over so many cells is a change of light
_FISH_CELLS = 3  # of the smallest fish: that many cells change together
_RATIO = 1.2  # of the largest change to the usual one, from which on something happens
# Factors of the usual change, up and down, a picture: in balance two pictures in three exceed it.
_UP, _DOWN = 1 + 0.01 * 2 / 3, 1 - 0.01 * 4 / 3
_FIRST_PICTURES = 30  # all are examined, until the usual change is known


class StillWater:
    """Keeps the usual change of the pictures of a source."""

    def __init__(self) -> None:
        self._mean: Float32[np.ndarray, "h w"] | None = None  # of each cell, grey levels
        self._change = np.zeros((0, 0), np.float32)  # of each cell from its mean, usually
        self._usual = 1.0  # largest change of a picture, over those of the cells
        self._num = 0

    @property
    def is_new(self) -> bool:
        """True until the usual change is known."""
        return self._num <= _FIRST_PICTURES

    def changes(self, image: UInt8[np.ndarray, "H W 3"], *, is_empty: bool) -> bool:
        """True if something happens in the next picture (BGR).

        `is_empty`: nothing is followed in it, so that the usual change may be learnt from it.
        """
        small = _small_grey(image)
        self._num += 1
        if self._mean is None:
            self._mean, self._change = small, np.full_like(small, _LEAST_CHANGE)
            return True
        difference = small - self._mean
        light = cv2.blur(difference, (_LIGHT_CELLS, _LIGHT_CELLS))
        change = np.abs(difference - light)
        ratios = change / (self._change + np.float32(_LEAST_CHANGE))
        largest = float(cv2.blur(ratios, (_FISH_CELLS, _FISH_CELLS)).max())
        self._mean += np.float32(_MEAN_RATE) * difference
        self._change += np.float32(_CHANGE_RATE) * (change - self._change)
        is_changed = largest > _RATIO * self._usual
        if self.is_new:
            self._usual += (largest - self._usual) / (self._num - 1)  # their mean
        elif is_empty:
            self._usual *= _UP if largest > self._usual else _DOWN
        return is_changed or self.is_new


def _small_grey(image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "h w"]:
    """Some of the green pixels, which are nearly the luma, averaged over cells."""
    height, width = image.shape[:2]
    longer = max(height, width)
    step = max(1, longer // (2 * _LONGER_PX))  # twice as many as cells, each way
    scale = min(1.0, _LONGER_PX / longer)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    few = np.ascontiguousarray(image[::step, ::step, 1])
    return cv2.resize(few, size, interpolation=cv2.INTER_AREA).astype(np.float32)
