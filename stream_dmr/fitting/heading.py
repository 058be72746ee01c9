"""Decide which end of a fish is its head, by the segmenter's cues along a track.

A heading is the direction from tail to head in the picture, in rays, of any length; 0 if it is not
known.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Camera
from stream_dmr.fitting.body import ROOT_ROTATION
from stream_dmr.messages import FishEnds

# Added to the L_rec of a fit with its head at the wrong end, when fits are compared. Chosen far
# above the differences of L_rec between fits, so that such a fit wins only if there is no other.
REVERSED_LOSS = 16.0
_MIN_CONFIDENCE = 0.9  # a less confident cue is no cue; chosen
# Most confidence in one frame's cue: a segmenter that errs is confident, and errs alike in many
# frames. Each frame the log odds decay by a fiftieth. Both chosen on trout that changed ends: 67
# times instead of 188 in 2,126 frames.
_MAX_CONFIDENCE = 0.95
_DECAY = 0.98


def heading_from_ends(ends: FishEnds | None, crop_camera: Camera) -> Float[np.ndarray, "2"]:
    """The heading by a segmenter's ends; 0 if they are missing or too uncertain."""
    if ends is None or not ends.confidence >= _MIN_CONFIDENCE:
        return np.zeros(2)
    head, tail = crop_camera.back_project(np.stack([ends.head_px, ends.tail_px]))[:, :2]
    return head - tail


def is_reversed(
    parameters: Float[np.ndarray, "*B P"], heading: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, "*B"]:
    """True if a body of these parameters has its head at the other end than the heading."""
    if not heading.any():  # most are not known
        return np.zeros(parameters.shape[:-1], np.bool_)
    root = Rotation.from_rotvec(parameters[..., ROOT_ROTATION].reshape(-1, 3))
    forward = root.apply([-1.0, 0.0, 0.0])[:, :2]
    return (forward @ heading < 0).reshape(parameters.shape[:-1])


class HeadTracker:
    """Log odds along a track of which end is the head: a fish doesn't turn round in a frame."""

    def __init__(self) -> None:
        self._forward: np.ndarray | None = None  # tail to head of the last fit, 2 numbers
        self._log_odds = 0.0  # that this is right

    def correct(self, ends: FishEnds | None) -> FishEnds | None:
        """A frame's cue, reversed if the frames before outweigh it; None without a cue."""
        if ends is None:
            return None
        forward = ends.head_px - ends.tail_px
        if self._forward is None:
            self._forward = forward
        agrees = bool(forward @ self._forward >= 0)
        probability = min(max(0.5, ends.confidence), _MAX_CONFIDENCE)
        log_odds = math.log(probability / (1 - probability))
        self._log_odds = _DECAY * self._log_odds + (log_odds if agrees else -log_odds)
        confidence = 1 / (1 + math.exp(-abs(self._log_odds)))
        if agrees == (self._log_odds >= 0):
            return replace(ends, confidence=confidence)
        return FishEnds(head_px=ends.tail_px, tail_px=ends.head_px, confidence=confidence)

    def update(self, keypoints_px: Float[np.ndarray, "3 2"]) -> None:
        """Take the direction of this frame's fit, to compare the next frame's cue with."""
        forward = keypoints_px[0] - keypoints_px[2]
        if self._forward is not None and forward @ self._forward < 0:
            self._log_odds = -self._log_odds
        self._forward = forward
