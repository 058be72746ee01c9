"""Fish by their motion; in the first frames, whose background is not known, also by their looks.

A fish of the first picture is taken for background, and is seen only when it has moved by its own
length. Looks also find marks and reflections, and motion finds plants that sway. What either finds
starts a track, and counts as a fish once it has moved from its place.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.detector import Candidate, Detector, fraction_inside
from stream_dmr.segmentation.detection.motion_detector import MotionDetector

_FIRST_FRAMES = 20  # in which looks are needed: as long as the background takes to be learnt
_MAX_OVERLAP = 0.3  # of a shape found by its looks with a moving one; above, it is that one


class FusedDetector:
    """A `Detector` of what moves and, at first, of what looks like fish."""

    def __init__(self, motion: MotionDetector, open_looks: Callable[[], Detector]) -> None:
        """`open_looks` opens the detector by looks, at the first frame."""
        self._motion = motion
        self._open_looks = open_looks
        self._looks: Detector | None = None
        self._num_frames = 0

    @property
    def refused(self) -> Mapping[str, int]:
        """The moving shapes of all frames that were no candidates, by reason."""
        return self._motion.refused

    def find(self, frame: Frame) -> list[Candidate]:
        """The candidates of one frame."""
        found = self._motion.find(frame)
        self._num_frames += 1
        if self._num_frames > _FIRST_FRAMES:
            self._looks = None
        else:
            self._looks = self._looks or self._open_looks()
            found += self._unmoved(frame, self._looks, found)
        return [self._placed(one, frame) for one in found]

    def _unmoved(self, frame: Frame, looks: Detector, moving: list[Candidate]) -> list[Candidate]:
        """What looks like fish where nothing moves."""
        boxes = [one.bbox_xyxy_px for one in moving]
        found = []
        for one in looks.find(frame):
            box = one.bbox_xyxy_px
            overlaps = [
                max(fraction_inside(box, other), fraction_inside(other, box)) for other in boxes
            ]
            if max(overlaps, default=0.0) <= _MAX_OVERLAP:
                found.append(one)
        return found

    def _placed(self, one: Candidate, frame: Frame) -> Candidate:
        """A candidate with its place in the scene."""
        middle = (one.bbox_xyxy_px[:2] + one.bbox_xyxy_px[2:]) / 2
        place = self._motion.scene_point(middle, shape=frame.image.shape[:2])
        return replace(one, place_px=np.asarray(place))
