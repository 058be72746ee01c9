"""Frames with bright rectangles for fish, and the boxes that a detector gives of them."""

from collections.abc import Iterable

import numpy as np

from stream_dmr.detection.detector import Candidate
from stream_dmr.messages import Frame
from tests.support.frames import frame_of

WIDTH, HEIGHT = 640, 480
_BACKGROUND = 60
Spot = tuple[float, float, int, int, int]  # center x, y; width, height; grey level


def spots_frame(spots: Iterable[Spot], index: int) -> Frame:
    image = np.full((HEIGHT, WIDTH, 3), _BACKGROUND, np.uint8)
    for x, y, w, h, level in spots:
        left, top = round(x - w / 2), round(y - h / 2)
        image[max(top, 0) : top + h, max(left, 0) : left + w] = level
    image[-20:, -20:] = 30 * (index % 3)  # no picture repeats the one before
    return frame_of(image, index)


def spots_candidates(spots: Iterable[Spot]) -> list[Candidate]:
    boxes = [
        np.array([x - w / 2, y - h / 2, x + w / 2, y + h / 2]).clip(0, [WIDTH, HEIGHT] * 2)
        for x, y, w, h, _ in spots
    ]
    return [Candidate(bbox_xyxy_px=box, score=1.0) for box in boxes]


def climbing(i: float, *, x: float = 300.0, speed: float = 12.0) -> Spot:
    """A fish that is hauled up, in its i-th frame."""
    return (x, 420 - speed * i, 40, 100, 200)
