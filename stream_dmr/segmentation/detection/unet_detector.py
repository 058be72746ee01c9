"""Fish in the whole frame by the network that also finds masks: seen coarsely, without a box.

Where the sea moves so much that nothing stands out by its motion, fish still look like fish.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.segmentation.network.unet_segmenter import UNetSegmenter

_MULTIPLE_PX = 16  # the network halves its input four times
_LEAST_PX = 24  # area in the network's picture


class UNetDetector:
    """The connected shapes that the network takes for fish; their score is its confidence."""

    def __init__(self, segmenter: UNetSegmenter, *, longer_px: int) -> None:
        """`longer_px`: of the picture that the network sees; fish should be 40 to 140 px there."""
        self._segmenter = segmenter
        self._longer_px = longer_px

    def find(self, frame: Frame) -> list[Candidate]:
        """The fish of one frame."""
        height, width = frame.image.shape[:2]
        scale = self._longer_px / max(width, height)
        size = [
            _MULTIPLE_PX * max(1, round(side * scale / _MULTIPLE_PX)) for side in (width, height)
        ]
        small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        probability = self._segmenter.segment_all(small)
        fish = cv2.resize(probability, (width, height), interpolation=cv2.INTER_LINEAR)
        least = _LEAST_PX * width * height / (size[0] * size[1])
        return [_candidate(shape, fish) for shape in _shapes(fish > 0.5, least)]


def _shapes(fish: Bool[np.ndarray, "H W"], least_px: float) -> list[Bool[np.ndarray, "H W"]]:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(fish.astype(np.uint8))
    large = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= least_px]
    return [labels == i for i in large]


def _candidate(
    shape: Bool[np.ndarray, "H W"], probability: Float32[np.ndarray, "H W"]
) -> Candidate:
    x, y, w, h = cv2.boundingRect(shape.view(np.uint8))
    foreground = shape[y : y + h, x : x + w].copy()
    return Candidate(
        bbox_xyxy_px=np.array([x, y, x + w, y + h], np.float64),
        score=float(probability[shape].mean()),
        foreground=foreground,
    )
