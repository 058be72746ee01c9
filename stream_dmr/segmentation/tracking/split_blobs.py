"""One moving shape that several fish share, cut into theirs by where each should be now.

Shapes of moving things run into one another long before fish hide each other. A fish hardly changes
from one frame to the next, so its last shape, moved on, says which pixels are its own; what is left
over and as large as a fish is another one, even one that nobody has seen yet.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stream_dmr.segmentation.detection.detector import Candidate, whole_pixels

_THERE = 0.6  # of a fish's expected shape is to be seen, or it is not there
_REACH = 0.1  # of a fish's length: so far from where it is expected its outline may be
_FISH = 0.3  # of the smallest fish's area: a smaller piece is none
_LONGER = 1.3  # times a fish's length, and it may be several
_WIDER = 0.6  # of a fish's length, likewise: turning makes none so wide
_THREAD = 0.06  # of a fish's length: what is thinner is a line or a sliver


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Expected:
    """A fish's last shape, where it should be now, and what is known of its size."""

    shape: Bool[np.ndarray, "h w"]
    corner: Float[np.ndarray, "2"]  # frame x, y of its first pixel
    length_px: float
    area_px: float
    is_whole: bool  # it was seen by itself, so its size is known


def part(candidate: Candidate, fish: Sequence[Expected]) -> list[Candidate]:
    """The candidate's pieces: one for each of the fish that shows enough, and those of no fish.

    The candidate itself where it has no `foreground`, or no second piece is to be found.
    """
    if candidate.foreground is None:
        return [candidate]
    x, y, _, _ = whole_pixels(candidate.bbox_xyxy_px)
    fish = [one for one in fish if _share(one, candidate.foreground, (x, y)) > _THERE]
    if not fish or (len(fish) == 1 and not _may_be_several(candidate.foreground, fish[0])):
        return [candidate]
    away = np.stack([_away(one, candidate.foreground.shape, (x, y)) for one in fish])
    nearest = away.argmin(axis=0)
    reach = np.array([max(2.0, _REACH * one.length_px) for one in fish])
    is_near = away.min(axis=0) <= reach[nearest]
    least = _FISH * min(one.area_px for one in fish)
    thread = round(_THREAD * min(one.length_px for one in fish)) | 1
    owned = [candidate.foreground & is_near & (nearest == i) for i in range(len(fish))]
    pieces = [_largest(_opened(one, thread)) for one in owned]
    pieces += _components(_opened(candidate.foreground & ~is_near, thread))
    pieces = [piece for piece in pieces if np.count_nonzero(piece) >= least]
    if len(pieces) < 2:
        return [candidate]
    return [_candidate(piece, candidate, (x, y)) for piece in pieces]


def _may_be_several(shape: Bool[np.ndarray, "H W"], fish: Expected) -> bool:
    """Whether this is too long or too wide for this fish; one that turns only widens."""
    if not fish.is_whole:
        return False
    width_px, length_px = extent(shape)
    return length_px > _LONGER * fish.length_px or width_px > _WIDER * fish.length_px


def extent(shape: Bool[np.ndarray, "H W"]) -> tuple[float, float]:
    """Width and length of the smallest rectangle around it, px; 0 where there is nothing."""
    points = cv2.findNonZero(shape.view(np.uint8))
    sides = (0.0, 0.0) if points is None else cv2.minAreaRect(points)[1]
    return min(sides), max(sides)


def _share(fish: Expected, foreground: Bool[np.ndarray, "H W"], corner: tuple[int, int]) -> float:
    """How much of a fish's expected shape a region, which begins at `corner`, shows."""
    seen = foreground & _placed(fish, foreground.shape, corner)
    return np.count_nonzero(seen) / max(np.count_nonzero(fish.shape), 1)


def _away(
    fish: Expected, shape: tuple[int, ...], corner: tuple[int, int]
) -> Float[np.ndarray, "H W"]:
    """How far each pixel of a region is from a fish's expected shape, px."""
    sea = (~_placed(fish, shape, corner)).astype(np.uint8)
    return cv2.distanceTransform(sea, cv2.DIST_L2, cv2.DIST_MASK_3).astype(np.float64)


def _placed(
    fish: Expected, shape: tuple[int, ...], corner: tuple[int, int]
) -> Bool[np.ndarray, "H W"]:
    """The expected shape in the pixels of a region."""
    placed = np.zeros(shape, bool)
    x, y = np.round(fish.corner - corner).astype(int).tolist()
    top, left = max(0, y), max(0, x)
    inside = fish.shape[max(-y, 0) : max(shape[0] - y, 0), max(-x, 0) : max(shape[1] - x, 0)]
    placed[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    return placed


def _opened(mask: Bool[np.ndarray, "H W"], diameter: int) -> UInt8[np.ndarray, "H W"]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter))
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc)


def _components(mask: UInt8[np.ndarray, "H W"]) -> list[Bool[np.ndarray, "H W"]]:
    count, labels, _, _ = cv2.connectedComponentsWithStats(mask)
    return [labels == label for label in range(1, count)]


def _largest(mask: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    parts = _components(mask)
    return max(parts, key=np.count_nonzero) if parts else mask > 0


def _candidate(
    piece: Bool[np.ndarray, "H W"], whole: Candidate, corner: tuple[int, int]
) -> Candidate:
    x, y, w, h = cv2.boundingRect(piece.view(np.uint8))
    box = np.array([x, y, x + w, y + h], np.float64) + np.tile(corner, 2)
    return Candidate(
        bbox_xyxy_px=box, score=whole.score, foreground=piece[y : y + h, x : x + w].copy()
    )
