"""Which end is the head: what a segmenter says of one frame, weighed by the frames before.

A heading is the way from tail to head in the picture, in rays, of any length; 0 where nobody knows.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Camera
from stream_dmr.fitting.parameters import ROOT_ROTATION
from stream_dmr.messages import FishEnds

# Added to the L_rec of a fit whose head is at the wrong end, when fits are compared: such a one is
# taken where there is no other.
TURNED = 16.0
_SURE = 0.9  # who is less sure than this, of which end is the head, has said nothing
# So sure is a frame's cue at the most, since a segmenter that errs does so surely, and in many
# frames alike; and what it says is forgotten by a fiftieth a frame.
_MOST_SURE = 0.95
_MEMORY = 0.98


def told(ends: FishEnds | None, crop_camera: Camera) -> Float[np.ndarray, "2"]:
    """The heading that a segmenter surely sees."""
    if ends is None or not ends.confidence >= _SURE:
        return np.zeros(2)
    head, tail = crop_camera.back_project(np.stack([ends.head_px, ends.tail_px]))[:, :2]
    return head - tail


def is_turned(
    parameters: Float[np.ndarray, "*B P"], heading: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, "*B"]:
    """Whether the body of such parameters has its head at the other end."""
    if not heading.any():  # most are not known
        return np.zeros(parameters.shape[:-1], np.bool_)
    root = Rotation.from_rotvec(parameters[..., ROOT_ROTATION].reshape(-1, 3))
    forward = root.apply([-1.0, 0.0, 0.0])[:, :2]
    return (forward @ heading < 0).reshape(parameters.shape[:-1])


class HeadMemory:
    """Of one track: its fish doesn't turn round between two frames, whatever a frame says."""

    def __init__(self) -> None:
        """Nothing has been seen yet."""
        self._forward: np.ndarray | None = None  # tail to head of the last fit, 2 numbers
        self._log_odds = 0.0  # that this is right

    def weigh(self, ends: FishEnds | None) -> FishEnds | None:
        """A frame's cue, turned round where the frames before say so; None where it has none."""
        if ends is None:
            return None
        forward = ends.head_px - ends.tail_px
        if self._forward is None:
            self._forward = forward
        is_same_way = bool(forward @ self._forward >= 0)
        sureness = min(max(0.5, ends.confidence), _MOST_SURE)
        said = math.log(sureness / (1 - sureness))
        self._log_odds = _MEMORY * self._log_odds + (said if is_same_way else -said)
        confidence = 1 / (1 + math.exp(-abs(self._log_odds)))
        if is_same_way == (self._log_odds >= 0):
            return replace(ends, confidence=confidence)
        return FishEnds(head_px=ends.tail_px, tail_px=ends.head_px, confidence=confidence)

    def follow(self, keypoints_px: Float[np.ndarray, "3 2"]) -> None:
        """Take the direction of this frame's fit, to compare the next frame's cue with."""
        forward = keypoints_px[0] - keypoints_px[2]
        if self._forward is not None and forward @ self._forward < 0:
            self._log_odds = -self._log_odds
        self._forward = forward
