"""What tells a fish from what only moves, and from what only looks like one.

Plants sway and marks glitter in their places, rock passes by before a camera that moves; none of
them looks like a fish. Letters and stones may, but stay where they are.
"""

import numpy as np
from jaxtyping import Float

from stream_dmr.segmentation.detection.detector import FISH_LIKE, Candidate

_SURE = 0.6  # of how much it looks like a fish: in so many frames it need not move
_MIN_SURE_FRAMES = 4
# Of all frames: a stone that is seen for hours looks like a fish in a few of them. Chosen; visible
# fish of real clips look like one in 40 % and more.
_MIN_SURE_SHARE, _MIN_FISH_LIKE_SHARE = 0.25, 0.1
# Sizes from where it was first seen. What went far is looked at in its own box alone, since the
# network for masks loses a thin fish in a wider one.
_MIN_MOTION = 0.25
_FAR = 0.5


class FishEvidence:
    """Of one track, over all its frames."""

    def __init__(self, candidate: Candidate, size_px: float) -> None:
        """`size_px`: the longer side of what is followed."""
        self._first_edges_px = _edges_px(candidate)
        self._need_not_move = candidate.place_px is None  # somebody found it
        self._motion = 0.0
        self._judged_frames = self._fish_like_frames = self._sure_frames = 0
        self.closer_looks = self._fish_like_closer = 0  # how many there were, and of a fish
        self.add(candidate, size_px)

    def add(self, candidate: Candidate, size_px: float) -> None:
        """Take the candidate of another frame into account."""
        edges_px = _edges_px(candidate)
        if edges_px is not None and self._first_edges_px is not None:
            is_outlined = candidate.foreground is not None
            distance_px = _distance(self._first_edges_px, edges_px, is_outlined=is_outlined)
            self._motion = max(self._motion, distance_px / size_px)
        if candidate.looks is not None:
            self._judged_frames += 1
            self._fish_like_frames += candidate.looks >= FISH_LIKE
            self._sure_frames += candidate.looks >= _SURE

    def add_closer_look(self, looks: float) -> None:
        """Take into account how much it looks like a fish in a picture of its surroundings."""
        self.closer_looks += 1
        self._fish_like_closer += looks >= FISH_LIKE

    @property
    def has_moved(self) -> bool:
        """True once it left its place, and for what need not move."""
        return self._is_sure or self._motion > _MIN_MOTION

    @property
    def went_far(self) -> bool:
        """True once it is far from its first place, and for what need not move."""
        return self._is_sure or self._motion > _FAR

    @property
    def _is_sure(self) -> bool:
        """True for what somebody found, and for what looked like a fish often enough."""
        needed = max(_MIN_SURE_FRAMES, _MIN_SURE_SHARE * self._judged_frames)
        return self._need_not_move or self._sure_frames >= needed

    def looks_like_a_fish(self, min_frames: int) -> bool:
        """True once it did in so many frames, and for what nothing judged."""
        is_rare = self._fish_like_frames < _MIN_FISH_LIKE_SHARE * self._judged_frames
        seen = self._fish_like_closer + (0 if is_rare else self._fish_like_frames)
        return self._judged_frames == 0 or seen >= min_frames


def _edges_px(candidate: Candidate) -> Float[np.ndarray, "2 2"] | None:
    """Left and top, right and bottom of its box where it is in the scene."""
    if candidate.place_px is None:
        return None
    half = (candidate.bbox_xyxy_px[2:] - candidate.bbox_xyxy_px[:2]) / 2
    return np.stack([candidate.place_px - half, candidate.place_px + half])


def _distance(
    before: Float[np.ndarray, "2 2"], now: Float[np.ndarray, "2 2"], *, is_outlined: bool
) -> float:
    """How far a box has moved: its middle, or of a network's box, which may jump, both edges."""
    shifts = now - before
    if is_outlined:
        return float(np.hypot(*shifts.mean(axis=0)))
    is_shared = shifts[0] * shifts[1] > 0
    return float(np.hypot(*np.where(is_shared, np.abs(shifts).min(axis=0), 0.0)))
