"""Looks help motion in the first frames, and say of what they find that it has not moved."""

import numpy as np

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.segmentation.detection.fused_detector import FusedDetector
from stream_dmr.segmentation.detection.motion_detector import MotionDetector, MotionSettings
from tests.support.frames import frame_of

STILL = Candidate(bbox_xyxy_px=np.array([20.0, 20.0, 80.0, 60.0]), score=0.9)


class Looks:
    """Finds everything where it is; also the shape that moves."""

    def __init__(self, *found: Candidate) -> None:
        self.refused: dict[str, int] = {}
        self._found = found

    def find(self, frame: Frame) -> list[Candidate]:
        return list(self._found)


def frame(i: int) -> Frame:
    image = np.full((240, 320, 3), 60, np.uint8)
    image[150:180, 100 + 10 * i : 170 + 10 * i] = 220
    return frame_of(image, i)


def test_what_looks_alone_find_has_not_moved_and_ends_with_the_first_frames():
    detector = FusedDetector(MotionDetector(MotionSettings()), lambda: Looks(STILL))
    found = [detector.find(frame(i % 8)) for i in range(1, 40)]
    alone = [[one for one in some if one.unmoved_at_px is not None] for some in found]
    assert all(len(some) == 1 for some in alone[:20])
    assert not any(alone[20:])
    for some in alone[:20]:
        np.testing.assert_allclose(some[0].unmoved_at_px, [50, 40], atol=1)
        np.testing.assert_array_equal(some[0].bbox_xyxy_px, STILL.bbox_xyxy_px)


def test_a_shape_that_moves_is_found_once():
    box = np.array([140.0, 150.0, 210.0, 180.0])
    both = Looks(STILL, Candidate(bbox_xyxy_px=box, score=0.9))
    detector = FusedDetector(MotionDetector(MotionSettings()), lambda: both)
    found = [detector.find(frame(i)) for i in range(5)][-1]
    moving = [one for one in found if one.unmoved_at_px is None]
    assert len(moving) == 1
    assert len(found) == 2
