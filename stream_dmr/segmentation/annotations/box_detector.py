"""Another program's detections, from a file without ids: they are followed like our own."""

from collections.abc import Mapping, Sequence

import numpy as np

from stream_dmr.messages import Frame
from stream_dmr.segmentation.annotations.boxes import Box
from stream_dmr.segmentation.detection.detector import Candidate


class BoxDetector:
    """Gives a frame the boxes that a file has for it, as far as they lie in the picture."""

    def __init__(self, frames: Mapping[int, Sequence[Box]]) -> None:
        self._frames = frames

    def find(self, frame: Frame) -> list[Candidate]:
        """The boxes of a frame by its number."""
        height, width = frame.image.shape[:2]
        candidates = []
        for box in self._frames.get(frame.frame_index, ()):
            inside = box.bbox_xyxy_px.clip(0, [width, height, width, height])
            if np.all(inside[2:] - inside[:2] >= 1):
                candidates.append(Candidate(bbox_xyxy_px=inside, score=box.score))
        return candidates
