"""Confirm a track as a fish once it is inside the zone and was clearly segmented in enough frames.

The tracker follows all that moves. Gaffs and waves are distinguished from fish by their masks,
which are empty or of low confidence.

Plants sway, marks glitter and rocks pass by before a moving camera, but none of them looks like a
fish. Letters and stones may look like a fish, but they stay in place.
"""

from collections import Counter, deque
from collections.abc import Collection
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator

from stream_dmr.detection.detector import Candidate
from stream_dmr.messages import FishCrop
from stream_dmr.settings import Settings

_MAX_KEPT_CROPS = 10  # of a track that is not confirmed; chosen
# After so many frames in a row with empty or very doubtful masks, a track follows another thing:
# the place where its fish was. Simulated fish are unclear in at most three frames in a row.
_MAX_EMPTY_FRAMES, _NOTHING = 5, 0.2
# Share of a track's frames whose mask is surer by so much than one in which it is clear. A lamp or
# a leaf that is seen for hours is clear in four frames, a weed that sways in one of three or four.
# Of 63 real fish all but one were so sure in a quarter of them; see docs/research/tracking.md.
# A fish that comes into view slowly is unsure while the picture cuts it: these frames don't count.
_MIN_SURE_SHARE, _SURER = 0.25, 0.08

Fraction = Annotated[float, Field(ge=0, le=1)]


class ConfirmationSettings(Settings):
    """The part of `[track_fish]` that decides which tracks count as fish; each counts once."""

    min_track_frames: int = Field(
        default=4, ge=1, description="frames in which a fish is clearly seen before it counts"
    )
    min_fish_like_frames: int = Field(
        default=2,
        ge=0,
        description="frames in which what moves has to look like a fish to the network as well; "
        "0: motion and a mask are enough",
    )
    min_mask_confidence: float = Field(
        default=0.52, ge=0, le=1, description="mask_confidence from which on a fish is clearly seen"
    )
    zone: list[Fraction] = Field(
        default=[0.0, 0.0, 1.0, 1.0],
        min_length=4,
        max_length=4,
        description="left, top, right, bottom of where fish count, as fractions of the picture",
    )

    @field_validator("zone")
    @classmethod
    def _has_positive_area(cls, zone: list[float]) -> list[float]:
        left, top, right, bottom = zone
        if not (left < right and top < bottom):
            raise ValueError("left, top, right, bottom with left < right and top < bottom")
        return zone


class FishConfirmation:
    """Decide which tracks are fish. A confirmed track stays confirmed and counts while seen."""

    def __init__(self, settings: ConfirmationSettings) -> None:
        self._settings = settings
        self._confirmed: set[int] = set()  # track numbers
        self._num_frames: Counter[int] = Counter()  # of unconfirmed tracks, whole or surely seen
        self._num_clear_frames: Counter[int] = Counter()  # likewise
        self._num_sure_frames: Counter[int] = Counter()  # likewise
        self._clear_crops: dict[int, deque[FishCrop]] = {}  # likewise, the latest
        self._num_empty_frames: Counter[int] = Counter()  # of confirmed tracks, in a row

    def is_confirmed(self, number: int) -> bool:
        return number in self._confirmed

    def update(self, number: int, crop: FishCrop, *, may_count: bool = True) -> list[FishCrop]:
        """Add a track's crop of one frame; return the crop if the track is a confirmed fish.

        The frame that confirms a fish also returns its earlier clear crops, which come first.
        `may_count`: False while other evidence doubts the fish. A confirmed fish remains a fish
        outside the zone. A crop without `mask_confidence` (a given mask) is clearly seen.
        """
        confidence = crop.quality.mask_confidence
        earlier: list[FishCrop] = []
        if number not in self._confirmed:
            clear = self._settings.min_mask_confidence
            is_sure = confidence is None or bool(confidence >= clear + _SURER)
            self._num_sure_frames[number] += is_sure
            self._num_frames[number] += is_sure or not crop.quality.touches_border
            if confidence is None or confidence >= clear:
                self._num_clear_frames[number] += 1
                kept = self._clear_crops.setdefault(number, deque(maxlen=_MAX_KEPT_CROPS))
                kept.append(crop)
            if not (may_count and self._is_in_zone(crop) and self.is_cut_out(number)):
                return []
            self._confirmed.add(number)
            earlier = [old for old in self._forget(number) if old is not crop]
        if confidence is None or confidence >= _NOTHING:
            self._num_empty_frames.pop(number, None)
        else:
            self._num_empty_frames[number] += 1
        return [*earlier, crop] if self._num_empty_frames[number] <= _MAX_EMPTY_FRAMES else []

    def forget_all_but(self, numbers: Collection[int]) -> None:
        """Forget the crops of all other tracks that are not confirmed."""
        for number in [n for n in self._num_frames if n not in numbers]:
            self._forget(number)

    def _forget(self, number: int) -> Collection[FishCrop]:
        """Forget what was counted of an unconfirmed track; return its clear crops."""
        del self._num_frames[number], self._num_clear_frames[number]
        del self._num_sure_frames[number]
        return self._clear_crops.pop(number, ())

    def is_cut_out(self, number: int) -> bool:
        """True if the masks of a track are such as to confirm it."""
        num_clear = self._num_clear_frames[number]  # 1 in a still, which shows a fish once
        needed = max(_MIN_SURE_SHARE * self._num_frames[number], 1)
        is_sure = num_clear == 1 or self._num_sure_frames[number] >= needed
        return num_clear >= self._settings.min_track_frames and is_sure

    def _is_in_zone(self, crop: FishCrop) -> bool:
        width, height = crop.frame_camera.width, crop.frame_camera.height
        x0, y0, x1, y1 = crop.bbox_xyxy_px.tolist()
        left, top, right, bottom = self._settings.zone
        return (
            left * width <= (x0 + x1) / 2 <= right * width
            and top * height <= (y0 + y1) / 2 <= bottom * height
        )


# Of how much it looks like a fish: in a picture of the whole frame, where other things do as well,
# and from near. Of fish of unseen sources 94 % look so, and 14 % of other things.
_SURE, _FISH_LIKE = 0.6, 0.2
_MIN_SURE_FRAMES, _MAX_CLOSER_LOOKS = 4, 8
# Share of all frames: a stone that is seen for hours looks like a fish in a few of them. Chosen;
# visible fish in real clips look like a fish in 40 % of their frames and more.
_MIN_SURE_LOOKS, _MIN_FISH_LIKE_SHARE = 0.25, 0.1
# Sizes from the place where it was first seen. A candidate that went far is cut out in its own box
# alone, since the network for masks loses a thin fish in a wider box.
_MIN_MOTION = 0.25
_FAR = 0.5
# A track that may not count is cut out in its first frames and then in one of so many: half of the
# crops of an aquarium were of rock. Simulated fish may count by then; chosen, see
# docs/research/tracking.md.
_ALWAYS_CUT_OUT, _CUT_OUT_EVERY = 8, 4
# Share of how far the camera has moved: what is nearer or farther than the scene at large drifts by
# so much in it. Without it 10 instead of 5 things count in a film that pans past rock.
_PARALLAX = 0.5


class FishEvidence:
    """Evidence for and against one track being a fish, over all its frames."""

    def __init__(self, candidate: Candidate, size_px: float) -> None:
        """`size_px`: the longer side of the candidate."""
        self._first_edges_px = _edges_px(candidate)
        self._first_offset_px = _camera_offset_px(candidate)
        self._need_not_move = candidate.place_px is None  # somebody found it
        self._motion = 0.0
        self._frames = 0
        self._judged_frames = self._sure_frames = 0
        self.closer_looks = self._fish_like_closer = 0  # how many there were, and of a fish
        self.add(candidate, size_px)

    def add(self, candidate: Candidate, size_px: float) -> None:
        self._frames += 1
        edges_px = _edges_px(candidate)
        if edges_px is not None and self._first_edges_px is not None:
            is_outlined = candidate.foreground is not None
            distance_px = _distance(self._first_edges_px, edges_px, is_outlined=is_outlined)
            travel_px = np.hypot(*(_camera_offset_px(candidate) - self._first_offset_px))
            own_px = distance_px - _PARALLAX * float(travel_px)
            self._motion = max(self._motion, own_px / size_px)
        if candidate.looks is not None:
            self._judged_frames += 1
            self._sure_frames += candidate.looks >= _SURE

    def add_closer_look(self, looks: float) -> None:
        """Take into account how much it looks like a fish from near."""
        self.closer_looks += 1
        self._fish_like_closer += looks >= _FISH_LIKE

    @property
    def wants_closer_look(self) -> bool:
        """True if another look may change the verdict: each after twice as many frames.

        What comes into view is seen in part, and then whole.
        """
        frames = 2**self.closer_looks - 1
        return self.closer_looks < _MAX_CLOSER_LOOKS and self._judged_frames >= frames

    @property
    def is_due(self) -> bool:
        """True if it is cut out in this frame even if it may not count."""
        return self._frames <= _ALWAYS_CUT_OUT or self._frames % _CUT_OUT_EVERY == 0

    @property
    def has_moved(self) -> bool:
        """True if it left its place, or need not move to count."""
        return self._is_sure or self._motion > _MIN_MOTION

    @property
    def went_far(self) -> bool:
        """True if it is far from its first place, or need not move to count."""
        return self._is_sure or self._motion > _FAR

    @property
    def _is_sure(self) -> bool:
        """True if it was given, or looked like a fish often enough."""
        needed = max(_MIN_SURE_FRAMES, _MIN_SURE_LOOKS * self._judged_frames)
        return self._need_not_move or self._sure_frames >= needed

    def looks_like_a_fish(self, min_frames: int) -> bool:
        """True if it looked like a fish in so many frames, or if no detector judged it.

        From near, or surely in a tenth of the pictures of the whole frame.
        """
        is_rare = self._sure_frames < _MIN_FISH_LIKE_SHARE * self._judged_frames
        seen = self._fish_like_closer + (0 if is_rare else self._sure_frames)
        return self._judged_frames == 0 or seen >= min_frames


def _edges_px(candidate: Candidate) -> Float[np.ndarray, "2 2"] | None:
    """Left, top and right, bottom of its box in the scene; None without a place."""
    if candidate.place_px is None:
        return None
    half = (candidate.bbox_xyxy_px[2:] - candidate.bbox_xyxy_px[:2]) / 2
    return np.stack([candidate.place_px - half, candidate.place_px + half])


def _camera_offset_px(candidate: Candidate) -> Float[np.ndarray, "2"]:
    """From where it is seen to where it is in the scene: this changes as the camera moves."""
    middle = (candidate.bbox_xyxy_px[:2] + candidate.bbox_xyxy_px[2:]) / 2
    return np.zeros(2) if candidate.place_px is None else candidate.place_px - middle


def _distance(
    before: Float[np.ndarray, "2 2"], now: Float[np.ndarray, "2 2"], *, is_outlined: bool
) -> float:
    """How far a box has moved: its middle, or of a network's box, which may jump, both edges."""
    shifts = now - before
    if is_outlined:
        return float(np.hypot(*shifts.mean(axis=0)))
    is_shared = shifts[0] * shifts[1] > 0
    return float(np.hypot(*np.where(is_shared, np.abs(shifts).min(axis=0), 0.0)))
