"""Looks help motion in the first frames, and every candidate has its place in the scene."""

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


def is_still(one: Candidate) -> bool:
    return np.array_equal(one.bbox_xyxy_px, STILL.bbox_xyxy_px)


def test_looks_help_in_the_first_frames_and_candidates_have_places():
    detector = FusedDetector(MotionDetector(MotionSettings()), lambda: Looks(STILL))
    found = [detector.find(frame(i % 8)) for i in range(1, 40)]
    alone = [[one for one in some if is_still(one)] for some in found]
    assert all(len(some) == 1 for some in alone[:20])
    assert not any(alone[20:])
    for one in (one for some in found for one in some):
        middle = one.bbox_xyxy_px.reshape(2, 2).mean(axis=0)
        np.testing.assert_allclose(one.place_px, middle, atol=1)  # the camera is at rest


def test_a_shape_that_moves_is_found_once():
    box = np.array([140.0, 150.0, 210.0, 180.0])
    both = Looks(STILL, Candidate(bbox_xyxy_px=box, score=0.9))
    detector = FusedDetector(MotionDetector(MotionSettings()), lambda: both)
    found = [detector.find(frame(i)) for i in range(5)][-1]
    assert [is_still(one) for one in found] == [False, True]
