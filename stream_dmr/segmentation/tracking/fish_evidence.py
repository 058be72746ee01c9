"""What tells a fish from what only moves, and from what only looks like one.

Plants sway and marks glitter in their places, rock passes by before a camera that moves; none of
them looks like a fish. Letters and stones may, but stay where they are.
"""

import numpy as np

from stream_dmr.segmentation.detection.detector import FISH_LIKE, Candidate

_SURE = 0.6  # of how much it looks like a fish: in so many frames it need not move
_MIN_SURE_FRAMES = 4
# Sizes from where it was first seen. What went far is looked at in its own box alone, since the
# network for masks loses a thin fish in a wider one.
_MIN_MOTION = 0.25
_FAR = 0.5


class FishEvidence:
    """Of one track, over all its frames."""

    def __init__(self, candidate: Candidate, size_px: float) -> None:
        """`size_px`: the longer side of what is followed."""
        self._first_place_px = candidate.place_px
        self._need_not_move = candidate.place_px is None  # somebody found it
        self._motion = 0.0
        self._judged_frames = self._fish_like_frames = self._sure_frames = 0
        self.closer_looks = 0  # how many there were
        self.add(candidate, size_px)

    def add(self, candidate: Candidate, size_px: float) -> None:
        """Take the candidate of another frame into account."""
        if candidate.place_px is not None and self._first_place_px is not None:
            distance_px = float(np.hypot(*(candidate.place_px - self._first_place_px)))
            self._motion = max(self._motion, distance_px / size_px)
        if candidate.looks is not None:
            self._judged_frames += 1
            self._fish_like_frames += candidate.looks >= FISH_LIKE
            self._sure_frames += candidate.looks >= _SURE

    def add_closer_look(self, looks: float) -> None:
        """Take into account how much it looks like a fish in a picture of its surroundings."""
        self.closer_looks += 1
        self._fish_like_frames += looks >= FISH_LIKE

    @property
    def has_moved(self) -> bool:
        """True once it left its place, and for what need not move."""
        return self._need_not_move or self._is_sure or self._motion > _MIN_MOTION

    @property
    def went_far(self) -> bool:
        """True once it is far from its first place, and for what need not move."""
        return self._need_not_move or self._is_sure or self._motion > _FAR

    @property
    def _is_sure(self) -> bool:
        return self._sure_frames >= _MIN_SURE_FRAMES

    def looks_like_a_fish(self, min_frames: int) -> bool:
        """True once it did in so many frames, and for what nothing judged."""
        return self._judged_frames == 0 or self._fish_like_frames >= min_frames
