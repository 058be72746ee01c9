"""Fish in the whole frame by the network that also finds masks, at low resolution, without boxes.

For cameras and seas that move so much that no fish stands out by its motion.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.components import components
from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.segmentation.network.unet_interface import SIZE_MULTIPLE_PX
from stream_dmr.segmentation.network.unet_segmenter import UNetSegmenter

_MIN_AREA_PX = 24  # in the network's input; chosen by hand, a few pixels wide and high


class UNetDetector:
    """A `Detector` of connected shapes with fish probability above 0.5; the score is their mean."""

    def __init__(self, segmenter: UNetSegmenter, *, longer_px: int) -> None:
        """`longer_px`: longer side of the network's input; fish should be 40 to 140 px in it."""
        self._segmenter = segmenter
        self._longer_px = longer_px

    @property
    def refused(self) -> Mapping[str, int]:
        """Empty: what was not found is not known."""
        return {}

    def find(self, frame: Frame) -> list[Candidate]:
        """The candidates of one frame."""
        height, width = frame.image.shape[:2]
        scale = self._longer_px / max(width, height)
        size = [
            SIZE_MULTIPLE_PX * max(1, round(side * scale / SIZE_MULTIPLE_PX))
            for side in (width, height)
        ]
        small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        probability = self._segmenter.segment_all(small)
        fish = cv2.resize(probability, (width, height), interpolation=cv2.INTER_LINEAR)
        min_area_px = _MIN_AREA_PX * width * height / (size[0] * size[1])
        return [_candidate(shape, fish) for shape in _large_components(fish > 0.5, min_area_px)]


def _large_components(
    fish: Bool[np.ndarray, "H W"], min_area_px: float
) -> list[Bool[np.ndarray, "H W"]]:
    count, labels, stats = components(fish.astype(np.uint8))
    large = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= min_area_px]
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
