"""Candidates by motion against a background model."""

import math
from collections import Counter
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from pydantic import Field

from stream_dmr.compiled import compiled
from stream_dmr.detection.background_model import (
    Affine,
    BackgroundModel,
    CameraMotion,
    compose,
    estimate_similarity,
    warp,
)
from stream_dmr.detection.detector import Candidate
from stream_dmr.detection.picture_views import brightening_power, shrunk
from stream_dmr.geometry import components, oriented_extent
from stream_dmr.messages import Frame
from stream_dmr.settings import Settings

# Chosen on simulated scenes (seeds 900 to 903) and the trout clip; see docs/research/raw-video.md.
_POLE_WIDTH = 1 / 50  # of the longer side; a blob that is thinner throughout may be a gaff or line
_THIN_WIDTHS = 0.45, 0.65  # of a pole's: lines are thinner, slender fish on them thicker
_MIN_BODY_AREA = 3.0  # widths squared; a smaller thick part is a bend of a thin object
_MIN_BODY_RATIO = 0.3  # of the largest thick part; smaller parts are fins and hooks
_MAX_END_LENGTH = 0.35  # of the thick part's length, that tail and snout may add
# A slender fish has longer ends: a thin rest is one if it is no longer than this, likewise, since
# lines go on, and makes the thick part no broader than this many times, as a gaff's tip does.
_MAX_FREE_END, _MAX_BROADER = 0.8, 1.3
_MIN_THICKNESS = 0.06  # mean thickness over length; fish seen edge-on are thicker
_MIN_THICKNESS_PX = 3.5


class Refusal(StrEnum):
    """Why a moving shape is no fish."""

    SHORT = "shorter than [detect_fish] motion_min_length"
    LONG = "longer than [detect_fish] motion_max_length"
    THIN = "too thin for fish, as lines, gaffs and ripples are"


def fish_blobs(
    moving: Bool[np.ndarray, "H W"], *, min_length_px: float, max_length_px: float
) -> tuple[list[Bool[np.ndarray, "H W"]], Counter[Refusal]]:
    """The connected components that may be fish, without connected poles and lines.

    A thin component that reaches the edge of the picture is a pole or a line, but for a thicker
    stretch inside, which is a slender fish on its line; a thin component inside may be a fish seen
    edge-on. Also returns how many components were refused, by reason.
    """
    pole_px = max(3, round(_POLE_WIDTH * max(moving.shape))) | 1
    fish, refused = [], Counter[Refusal]()
    count, labels, stats = components(moving.view(np.uint8))
    height, width = moving.shape
    is_at_edge = np.ones(moving.shape, bool)
    is_at_edge[2:-2, 2:-2] = False
    for label in range(1, count):
        x, y, w, h, area = stats[label].tolist()
        touches_edge = min(x, y, width - x - w, height - y - h) <= 1
        if area < _MIN_BODY_AREA * pole_px**2 and math.hypot(w - 1, h - 1) + 1 < min_length_px:
            # Most moving components are such specks; opening them would have the same result.
            refused[Refusal.THIN if touches_edge else Refusal.SHORT] += 1
            continue
        part = np.s_[y : y + h, x : x + w]
        blobs = _without_poles(labels[part] == label, pole_px, is_at_edge[part])
        refused[Refusal.THIN] += not blobs
        for blob in blobs:
            refusal = _refusal(blob, min_length_px, max_length_px)
            if refusal is None:
                shape = np.zeros_like(moving)
                shape[part] = blob
                fish.append(shape)
            else:
                refused[refusal] += 1
    return fish, +refused


def _without_poles(
    blob: Bool[np.ndarray, "h w"], pole_px: int, is_at_edge: Bool[np.ndarray, "h w"]
) -> list[Bool[np.ndarray, "h w"]]:
    """The thick parts of a blob, each with a fish's thin ends; none for a mere pole or line.

    Two thick parts that only a thin bridge joins are two fish that touch each other.
    """
    region = np.pad(blob, pole_px).astype(np.uint8)
    at_edge = np.pad(is_at_edge, pole_px)
    bodies = _bodies(region, pole_px)
    for thin in _THIN_WIDTHS:
        if bodies:
            break
        bodies = _bodies(region, round(thin * pole_px) | 1)
        if any(at_edge[body > 0].any() for body in bodies):
            return []
        bodies = [body for body in bodies if _is_thick(body, _sides_px(body)[1])]
    if not bodies:
        return [] if region[at_edge].any() else [blob]
    body_px = [max(cv2.boundingRect(body)[2:]) for body in bodies]
    if len(bodies) == 1 and max(blob.shape) <= body_px[0] + round(_MAX_END_LENGTH * body_px[0]):
        return [blob]
    ends_px = [round(_MAX_END_LENGTH * px) for px in body_px]
    fish, rest = _with_ends(bodies, ends_px, region)
    _add_free_ends(fish, rest, bodies, ends_px, is_at_edge=at_edge)
    return [blob[pole_px:-pole_px, pole_px:-pole_px] > 0 for blob in fish]


def _bodies(region: UInt8[np.ndarray, "h w"], width_px: int) -> list[UInt8[np.ndarray, "h w"]]:
    """The largest part that is so wide, and parts nearly as large; a tail fin is smaller."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width_px, width_px))
    opened = cv2.morphologyEx(region, cv2.MORPH_OPEN, kernel)
    count, labels, stats = components(opened)
    areas = stats[1:, cv2.CC_STAT_AREA]
    least = max(_MIN_BODY_AREA * width_px**2, _MIN_BODY_RATIO * max(areas, default=0))
    return [(labels == i).astype(np.uint8) for i in range(1, count) if areas[i - 1] >= least]


def _with_ends(
    bodies: list[UInt8[np.ndarray, "h w"]], ends_px: list[int], region: UInt8[np.ndarray, "h w"]
) -> tuple[list[UInt8[np.ndarray, "h w"]], UInt8[np.ndarray, "h w"]]:
    """Bodies grown within a region, back to the ends and no further, each before the others.

    Also returns what is left of the region.
    """
    free = region.copy()
    for body in bodies:
        free[body > 0] = 0
    grown = [body.copy() for body in bodies]
    for step in range(max(1, max(ends_px) // 2)):
        for body, end_px in zip(grown, ends_px, strict=True):
            if step < max(1, end_px // 2):
                new = cv2.bitwise_and(cv2.dilate(body, np.ones((3, 3), np.uint8)), free)
                body[new > 0] = 1
                free[new > 0] = 0
    return grown, free


def _add_free_ends(
    fish: list[UInt8[np.ndarray, "h w"]],
    rest: UInt8[np.ndarray, "h w"],
    bodies: list[UInt8[np.ndarray, "h w"]],
    ends_px: list[int],
    *,
    is_at_edge: Bool[np.ndarray, "h w"],
) -> None:
    """Add to each fish the short parts of the rest along it that end within the picture."""
    count, labels, stats = components(rest)
    for label in range(1, count):
        part = labels == label
        if is_at_edge[part].any():
            continue
        near = cv2.dilate(part.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
        touched = [i for i, one in enumerate(fish) if one[near].any()]
        if len(touched) != 1:
            continue
        (i,) = touched
        if max(stats[label, 2:4]) > _MAX_FREE_END / _MAX_END_LENGTH * ends_px[i]:
            continue
        whole = np.where(part, np.uint8(1), fish[i])
        breadth_px, length_px = _sides_px(whole)
        is_along = breadth_px <= _MAX_BROADER * _sides_px(bodies[i])[0]
        if is_along and _is_thick(whole, length_px):
            fish[i] = whole


def _sides_px(blob: Bool[np.ndarray, "h w"] | UInt8[np.ndarray, "h w"]) -> tuple[float, float]:
    """Breadth and length of a blob with its outer pixels."""
    breadth, length = oriented_extent(blob)
    return breadth + 1, length + 1


def _refusal(
    blob: Bool[np.ndarray, "h w"], min_length_px: float, max_length_px: float
) -> Refusal | None:
    """None if length and mean thickness (area over length) are those of a fish."""
    _, length_px = _sides_px(blob)
    if length_px < min_length_px:
        return Refusal.SHORT
    if length_px > max_length_px:
        return Refusal.LONG
    return None if _is_thick(blob, length_px) else Refusal.THIN


def _is_thick(blob: Bool[np.ndarray, "h w"] | UInt8[np.ndarray, "h w"], length_px: float) -> bool:
    thickness_px = np.count_nonzero(blob) / length_px
    return bool(thickness_px >= max(_MIN_THICKNESS * length_px, _MIN_THICKNESS_PX))


# Chosen on simulated scenes (seeds 900 to 903) and the trout clip; see docs/research/raw-video.md.
_MIN_CHANGE = 8  # grey levels between two pictures; less is noise
_MAX_STILL_SHARE = 0.1  # of a blob's pixels changed; with fewer it stands still
# Share of foreign pixels from which on the background is learnt anew: after a black picture, a lamp
# that is switched on or another shot it would take hundreds of pictures.
_ANOTHER_SCENE = 0.5
_STILL_RATE = 0.5  # learning rate of foreign blobs that stand still
# By the levels of a mask of moving pixels: errors of the model must fade there at last.
_RATES = np.array([1] + [0.02] * 255, np.float32)
_NEAR_THRESHOLD_RATIO = 0.65  # of the threshold, for pixels near pixels above it
_NEAR_PX = 11  # diameter of "near"
# By which the threshold falls where a power of 0 would brighten a picture; it is 0.5 or more.
# Chosen on drawn films made dark; see docs/research/raw-video.md.
_DARK_SHARE = 0.6
_IDENTITY = np.eye(2, 3)


class MotionSettings(Settings):
    """The part of `[detect_fish]` that the detector "motion" reads."""

    motion_working_px: int = Field(
        default=480, ge=120, le=4096, description="longer side of the pictures it works on, px"
    )
    motion_memory_frames: float = Field(
        default=20.0, ge=2, description="frames over which the background is learnt"
    )
    motion_min_distance: float = Field(
        default=5.0,
        gt=0,
        description="least distance of a fish's colours from the background, std; in the dark down "
        "to 0.7 of it, since fish stand out less there, and waves too",
    )
    motion_min_length: float = Field(
        default=0.03, gt=0, le=1, description="shortest fish, as a fraction of the longer side"
    )
    motion_max_length: float = Field(
        default=0.7, gt=0, le=1, description="longest fish, as a fraction of the longer side"
    )


class MotionDetector:
    """A `Detector` of blobs that move before a background, which is learnt and follows the camera.

    The background model keeps its own pixel grid, so that whole-pixel shifts suffice to follow the
    view; `_background_from_picture` maps each picture into it.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self._settings = settings
        self._camera = CameraMotion()
        self._background: BackgroundModel | None = None
        self._before: UInt8[np.ndarray, "h w 3"] | None = None  # last picture, background's pixels
        self._is_foreign: Bool[np.ndarray, "h w"] | None = None  # in the last picture's pixels
        self._background_from_picture: Affine = _IDENTITY
        self._shift_px = np.zeros(2)  # of the background, all together
        self.refused: Counter[str] = Counter()

    def find(self, frame: Frame) -> list[Candidate]:
        """The moving blobs of a frame whose size and thickness may be those of fish."""
        height, width = frame.image.shape[:2]
        moving = self._find_moving(shrunk(frame.image, self._settings.motion_working_px))
        blobs, refused = fish_blobs(
            moving,
            min_length_px=self._settings.motion_min_length * max(moving.shape),
            max_length_px=self._settings.motion_max_length * max(moving.shape),
        )
        self.refused.update(refused)
        return [_candidate(blob, width=width, height=height) for blob in blobs]

    def scene_point(
        self, point: Float[np.ndarray, "2"], *, shape: tuple[int, ...]
    ) -> Float[np.ndarray, "2"]:
        """A point of the last frame, of shape (H, W), without the camera's motion; px."""
        scale = min(1.0, self._settings.motion_working_px / max(shape))
        return (self._background_from_picture @ [*(point * scale), 1.0] - self._shift_px) / scale

    def _find_moving(self, small: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """The mask of pixels that differ from the background and move; learns the background."""
        background, aligned = self._align(small)
        picture = _planes(aligned)
        background.fill_unseen(picture)
        distance = background.distance(picture)
        share = 1 - _DARK_SHARE * (1 - brightening_power(small))
        foreign = _find_foreign(distance, share * self._settings.motion_min_distance)
        if background.is_young:
            foreign[background.uncover(picture, foreign)] = 0
        still = _find_still(foreign, aligned, self._before)
        rate = cv2.LUT(cv2.dilate(foreign, _disc(5)), _RATES)
        rate[still] = _STILL_RATE
        background.learn(picture, distance, rate)
        self._before = aligned
        self._is_foreign = self._to_picture(foreign) > 0
        return self._to_picture(foreign * ~still) > 0

    def _align(
        self, small: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[BackgroundModel, UInt8[np.ndarray, "h w 3"]]:
        """The background after the camera's motion, and the picture in the background's pixels."""
        grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
        foreign_px = 0 if self._is_foreign is None else np.count_nonzero(self._is_foreign)
        if foreign_px > _ANOTHER_SCENE * grey.size:
            self._begin_anew(grey.shape)
        if self._background is None or self._is_foreign is None or self._before is None:
            self._camera.step(grey, is_background=np.ones(grey.shape, bool))
            self._background = BackgroundModel(
                _planes(small), memory_frames=self._settings.motion_memory_frames
            )
            self._before = small
            return self._background, small
        motion = self._camera.step(grey, is_background=~self._is_foreign)
        if motion is not None:
            self._follow(motion, self._background, self._before, grey)
        if self._background_from_picture is _IDENTITY:
            return self._background, small
        return self._background, warp(small, self._background_from_picture)

    def _begin_anew(self, shape: tuple[int, ...]) -> None:
        """Forget the background; the place of the picture's middle in the scene stays."""
        middle = np.array([shape[1] / 2, shape[0] / 2])
        self._shift_px += middle - self._background_from_picture @ [*middle, 1.0]
        self._background, self._background_from_picture = None, _IDENTITY

    def _follow(
        self,
        motion: Affine,
        background: BackgroundModel,
        before: UInt8[np.ndarray, "h w 3"],
        grey: UInt8[np.ndarray, "h w"],
    ) -> None:
        """Shift the background by a motion's whole pixels; the pictures are warped by the rest."""
        place = compose(self._background_from_picture, cv2.invertAffineTransform(motion))
        center = np.array([grey.shape[1] / 2, grey.shape[0] / 2])
        x, y = np.round(center - place @ [*center, 1.0]).astype(int).tolist()
        background.shift(x, y)
        self._shift_px += (x, y)
        shift = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
        self._before = warp(before, shift)
        place = compose(shift, place)
        # Errors of the motions would add up; registration with the background's mean removes them.
        mean = cv2.merge(list(background.mean.clip(0, 255).astype(np.uint8)))
        mean = cv2.cvtColor(mean, cv2.COLOR_BGR2GRAY)
        correction = estimate_similarity(
            warp(grey, place), mean, is_background=np.ones(grey.shape, bool)
        )
        self._background_from_picture = place if correction is None else compose(correction, place)

    def _to_picture(self, layer: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
        """A layer in the background's pixels, in the pixels of the picture."""
        if self._background_from_picture is _IDENTITY:
            return layer
        size = (layer.shape[1], layer.shape[0])
        picture_from_background = cv2.invertAffineTransform(self._background_from_picture)
        return cv2.warpAffine(layer, picture_from_background, size, flags=cv2.INTER_NEAREST)


def _find_foreign(
    distance: Float32[np.ndarray, "h w"], threshold: float
) -> UInt8[np.ndarray, "h w"]:
    """1 in shapes above the threshold (std), and in pixels near them that are almost above it."""
    above = cv2.morphologyEx(_above(distance, threshold), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    almost = cv2.morphologyEx(
        _above(distance, _NEAR_THRESHOLD_RATIO * threshold), cv2.MORPH_OPEN, _disc(3)
    )
    near = cv2.bitwise_and(almost, cv2.dilate(above, _disc(_NEAR_PX)))
    # Close small holes only: two lines side by side must not become one fish.
    return cv2.morphologyEx(cv2.bitwise_or(above, near), cv2.MORPH_CLOSE, _disc(3))


def _above(distance: Float32[np.ndarray, "h w"], threshold: float) -> UInt8[np.ndarray, "h w"]:
    return (distance > threshold**2).astype(np.uint8)


def _disc(diameter_px: int) -> UInt8[np.ndarray, "k k"]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter_px, diameter_px))


def _find_still(
    foreign: UInt8[np.ndarray, "h w"],
    picture: UInt8[np.ndarray, "h w 3"],
    before: UInt8[np.ndarray, "h w 3"] | None,
) -> Bool[np.ndarray, "h w"]:
    """Foreign blobs that look as in the previous picture: stains, shadows, a new box on deck."""
    count, labels, stats = components(foreign)
    if before is None or count == 1:
        return np.zeros(foreign.shape, bool)
    num_changed = np.zeros(count, np.int64)
    _count_changed(labels, stats, picture, before, num_changed)
    is_still = num_changed < _MAX_STILL_SHARE * stats[:, cv2.CC_STAT_AREA]
    is_still[0] = False
    if not is_still.any():  # the usual case; indexing below takes ten times as long
        return np.zeros(foreign.shape, bool)
    return np.asarray(is_still)[np.asarray(labels, np.intp)]


@compiled
def _count_changed(
    labels: Int32[np.ndarray, "h w"],
    stats: Int32[np.ndarray, "N 5"],
    picture: UInt8[np.ndarray, "h w 3"],
    before: UInt8[np.ndarray, "h w 3"],
    counts: Int[np.ndarray, "N"],
) -> None:
    """Add up each label's pixels that changed in one of their colours; `stats` begin with boxes."""
    for n in range(1, len(stats)):
        x, y, width, height = stats[n, 0], stats[n, 1], stats[n, 2], stats[n, 3]
        for i in range(y, y + height):
            for j in range(x, x + width):
                if labels[i, j] == n:
                    for k in range(3):
                        if abs(int(picture[i, j, k]) - int(before[i, j, k])) > _MIN_CHANGE:
                            counts[n] += 1
                            break


def _planes(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "3 h w"]:
    return np.array(cv2.split(picture))


def _candidate(blob: Bool[np.ndarray, "h w"], *, width: int, height: int) -> Candidate:
    """A blob of the small picture in pixels of a frame of this size; edges scale, not centers."""
    x, y, w, h = cv2.boundingRect(blob.view(np.uint8))
    scale = np.array([width / blob.shape[1], height / blob.shape[0]] * 2)
    box = np.array([x, y, x + w, y + h]) * scale
    box = np.round(box).clip(0, [width, height, width, height])
    region = blob[y : y + h, x : x + w] * np.uint8(255)
    size = (int(box[2] - box[0]), int(box[3] - box[1]))
    return Candidate(bbox_xyxy_px=box, score=1.0, foreground=cv2.resize(region, size) > 127)
