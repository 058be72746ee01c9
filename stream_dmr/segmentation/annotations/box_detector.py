"""Detections of another program, from a boxes file without ids."""

from collections.abc import Mapping, Sequence

import numpy as np

from stream_dmr.messages import Frame
from stream_dmr.segmentation.annotations.annotated_box import AnnotatedBox
from stream_dmr.segmentation.annotations.box_files import unused_boxes
from stream_dmr.segmentation.detection.detector import Candidate


class BoxDetector:
    """A `Detector` that gives the boxes of a file, clipped to the frame."""

    def __init__(self, frames: Mapping[int, Sequence[AnnotatedBox]]) -> None:
        self._frames = frames
        self._last_frame = 0

    @property
    def refused(self) -> Mapping[str, int]:
        """Empty: every box of the file is a candidate."""
        return {}

    @property
    def unused(self) -> list[str]:
        """What of the file was not used so far."""
        return unused_boxes(self._frames, self._last_frame)

    def find(self, frame: Frame) -> list[Candidate]:
        """The file's boxes of this frame that are at least one pixel wide and high inside it."""
        self._last_frame = max(self._last_frame, frame.frame_index)
        height, width = frame.image.shape[:2]
        candidates = []
        for box in self._frames.get(frame.frame_index, ()):
            inside = box.bbox_xyxy_px.clip(0, [width, height, width, height])
            if np.all(inside[2:] - inside[:2] >= 1):
                candidates.append(Candidate(bbox_xyxy_px=inside, score=box.score))
        return candidates
