"""Detect from a small picture whether anything happens in it, and whether it is a new one at all.

Water moves all the time, more under wind, spray or a camera that sways. A change is therefore
measured twice against the scene itself: each cell of the picture against the usual change of that
cell, and the largest such change against the largest change of most pictures.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from stream_dmr.detection.picture_views import brightened, shrunk
from stream_dmr.messages import Frame

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
# Most levels by which an encoder changes a picture that it repeats, in means over so many px of a
# picture of so many. Two were the most; whatever moved changed five and more.
_MAX_REPEAT_CHANGE, _REPEAT_CELL_PX, _REPEAT_PX = 2.5, 5, 480
_MAX_REPEATS = 15  # consecutive ones; then the scene is at rest, and is examined


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


class Repeats:
    """Tells pictures that a recorder repeats: it makes more than its camera, or fills a gap."""

    def __init__(self) -> None:
        self._last: Float32[np.ndarray, "h w"] | None = None  # of the last that was none
        self._num = 0  # since then

    def is_repeat(self, frame: Frame) -> bool:
        """True if the next picture shows what the one before it shows."""
        small = replace(frame, image=shrunk(frame.image, _REPEAT_PX))
        grey = cv2.cvtColor(brightened(small).image, cv2.COLOR_BGR2GRAY)
        means = cv2.blur(grey.astype(np.float32), (_REPEAT_CELL_PX, _REPEAT_CELL_PX))
        is_new = (
            self._last is None
            or self._last.shape != means.shape
            or self._num == _MAX_REPEATS
            or cv2.norm(means, self._last, cv2.NORM_INF) > _MAX_REPEAT_CHANGE
        )
        self._num = 0 if is_new else self._num + 1
        if is_new:
            self._last = means
        return not is_new
