"""Find fish by their motion and by their looks.

Motion finds fish unlike any that the network has seen, with an outline, but also swaying plants. It
misses fish that hang still, finds parts of a fish that fills the picture, and two pieces of a fish
behind a gaff. Looks find fish that don't move, but also marks that look like fish. The finds of
both are followed; `tracking.confirmation` decides which of them count.

Most of a film is water, in which not every picture needs to be examined: see `passes_over`.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from pydantic import Field

from stream_dmr.detection.detector import Candidate, Detector
from stream_dmr.detection.motion_detector import MotionDetector
from stream_dmr.detection.picture_views import brightened, look_closer
from stream_dmr.detection.still_water import StillWater
from stream_dmr.geometry import box_iou, fraction_inside, whole_pixels
from stream_dmr.messages import Frame
from stream_dmr.settings import Settings

_MIN_IOU = 0.3  # of a moving blob with the box that scores its looks
# Least score of a box that surely shows a whole fish, and of a box that shows an object of its own.
_SURE, _SEEN = 0.6, 0.3
_MIN_INSIDE = 0.8  # of a piece of a fish, inside the fish's box
_MIN_WHOLE_IOU = 0.5  # of all pieces together with that box


class LookSettings(Settings):
    """The part of `[detect_fish]` about how often the detector "motion" looks at water."""

    look_every_s: float = Field(
        default=0.5,
        ge=0,
        le=60,
        description="where nothing changes and nothing is followed, a picture is looked at every "
        "so many seconds, so that a fish that hangs still is seen; 0: every picture",
    )


class FusedDetector:
    """A `Detector` of blobs that move and of boxes that look like fish."""

    def __init__(
        self, motion: MotionDetector, looks: Detector, settings: LookSettings | None = None
    ) -> None:
        self._motion, self.refused = motion, motion.refused
        self._looks = looks
        self._every_ns = round(1e9 * (settings or LookSettings()).look_every_s)
        self._water = StillWater()
        self._looked_ns = -self._every_ns  # capture time of the last that the network looked at
        self._passed: Frame | None = None  # the last frame, where it was not looked at
        self._must_look = True  # at the next frame, whether or not anything moves in it
        self._beside = ThreadPoolExecutor(1, "looks")  # both take as long as each other

    def passes_over(self, frame: Frame, *, is_followed: bool) -> bool:
        """True if the next frame need not be looked at, since nothing happens in it.

        `is_followed`: something found before is.
        """
        if not self._every_ns:
            return False
        is_changed = self._water.changes(frame.image, is_empty=not is_followed)
        is_due = not 0 <= frame.timestamp_ns - self._looked_ns < self._every_ns
        if not (is_changed or is_followed or is_due):
            self._passed = frame
            return True
        self._must_look = is_followed or is_due or self._water.is_new
        if is_changed and self._passed is not None:  # something begins
            self._must_look = True
            self._motion.find(self._passed)  # what moves is told from the picture before
        self._passed = None
        return False

    def find(self, frame: Frame) -> list[Candidate]:
        if self._must_look:
            looking = self._beside.submit(self._look, frame)
            moving, seen = self._motion.find(frame), looking.result()
        else:  # spray and waves go on for a while, but nothing of a fish's size moves
            moving = self._motion.find(frame)
            seen = self._look(frame) if moving else []
        if self._must_look or moving:
            self._looked_ns = frame.timestamp_ns
        return [
            replace(
                found, place_px=self._place(found, frame), looks=_looks(found.bbox_xyxy_px, seen)
            )
            for found in fuse(moving, seen)
        ]

    def look_closer(self, frame: Frame, bbox_xyxy_px: Float[np.ndarray, "4"]) -> float:
        """Score from 0 to 1 of a box as a fish, from near."""
        return look_closer(self._looks, brightened(frame), bbox_xyxy_px)

    def _look(self, frame: Frame) -> Sequence[Candidate]:
        return self._looks.find(brightened(frame))

    def _place(self, candidate: Candidate, frame: Frame) -> Float[np.ndarray, "2"]:
        middle = (candidate.bbox_xyxy_px[:2] + candidate.bbox_xyxy_px[2:]) / 2
        return np.asarray(self._motion.scene_point(middle, shape=frame.image.shape[:2]))


def fuse(moving: Sequence[Candidate], seen: Sequence[Candidate]) -> list[Candidate]:
    """The moving candidates, which have outlines, and those seen where nothing moves."""
    moving = _without_pieces(moving, seen)
    still = [
        fish
        for fish in seen
        if not any(_show_the_same(fish.bbox_xyxy_px, mover.bbox_xyxy_px) for mover in moving)
    ]
    return [*moving, *still]


def _without_pieces(moving: Sequence[Candidate], seen: Sequence[Candidate]) -> list[Candidate]:
    """The moving candidates, joined if they lie in the box of one fish."""
    found = list(moving)
    for fish in sorted(seen, key=lambda candidate: -candidate.score):
        if fish.score < _SURE:
            break
        others = [other for other in seen if other is not fish and other.score >= _SEEN]
        pieces = [part for part in found if _is_piece(part, fish, others)]
        if len(pieces) > 1:
            whole = _join(pieces)
            if box_iou(whole.bbox_xyxy_px, fish.bbox_xyxy_px) >= _MIN_WHOLE_IOU:
                found = [*(mover for mover in found if mover not in pieces), whole]
    return found


def _is_piece(candidate: Candidate, fish: Candidate, others: Sequence[Candidate]) -> bool:
    """True if a candidate lies in a fish's box and doesn't look more like another fish."""
    box, whole = candidate.bbox_xyxy_px, fish.bbox_xyxy_px
    alike = max(_MIN_IOU, box_iou(box, whole))
    is_inside = candidate.foreground is not None and fraction_inside(box, whole) >= _MIN_INSIDE
    return is_inside and not any(box_iou(box, other.bbox_xyxy_px) > alike for other in others)


def _join(pieces: Sequence[Candidate]) -> Candidate:
    """One candidate with the silhouettes of all pieces."""
    corners = np.array([whole_pixels(piece.bbox_xyxy_px) for piece in pieces])
    left, top = corners[:, :2].min(axis=0)
    right, bottom = corners[:, 2:].max(axis=0)
    foreground = np.zeros((bottom - top, right - left), bool)
    for piece, (x0, y0, x1, y1) in zip(pieces, corners, strict=True):
        foreground[y0 - top : y1 - top, x0 - left : x1 - left] |= piece.foreground
    box = np.array([left, top, right, bottom], np.float64)
    return replace(pieces[0], bbox_xyxy_px=box, foreground=foreground)


def _looks(bbox_xyxy_px: Float[np.ndarray, "4"], seen: Sequence[Candidate]) -> float:
    """Score from 0 to 1 of a box as a fish: the best score of the boxes that overlap it."""
    scores = (fish.score for fish in seen if _show_the_same(bbox_xyxy_px, fish.bbox_xyxy_px))
    return max(scores, default=0.0)


def _show_the_same(box: Float[np.ndarray, "4"], other: Float[np.ndarray, "4"]) -> bool:
    return box_iou(box, other) >= _MIN_IOU
