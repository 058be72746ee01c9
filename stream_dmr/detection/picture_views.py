"""Find fish in parts of a picture and in a wider picture, in the pixels of the picture itself.

And look closely at what was found: from near, other things look less like fish than from afar.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stream_dmr.detection.detector import Candidate, Detector
from stream_dmr.geometry import box_iou, fraction_inside, longer_side
from stream_dmr.messages import Frame

# Views for a closer look: their sides, in sizes of the box, and whether they are turned by 90
# degrees. And their least side, px. Chosen on photographs; see docs/research/real-pictures.md.
_CLOSE_VIEWS, _MIN_CLOSE_PX = ((1.15, False), (1.7, True)), 208
_SHOWN = 0.3  # IoU of a box that is looked at with what is seen there: it may lack a part
_FAINT = 0.1  # least score of what is looked at more closely
# A detector misses small fish, and fish that fill the picture or their tails. Chosen on photographs
# that it never saw; see docs/research/real-pictures.md.
_RIM = 0.25  # of the picture's longer side, around it
_LARGE = 0.4  # of the picture's longer side: fish that are taken from the picture with the rim
_TILE_SHARE = 0.625  # of the picture's sides: two by two overlap by a quarter of the picture
_EDGE_PX = 3  # from a tile's edge: a box so near may be cut
_SURE_NEAR = 0.45  # least score in a tile, where parts of other things look like fish
_SAME_FISH, _INSIDE = 0.45, 0.9  # IoU of two boxes of a fish; share of a part in the fish's box
# Share of the longest fish in the picture: shorter finds are dirt, scales or leaves beside it, and
# only their size shows it. See docs/research/real-lengths.md. And least share of the picture's
# longer side: of shorter finds lamps and handles are as sure; see docs/research/real-pictures.md.
_SHORTEST, _LEAST = 0.1, 0.05
# Longer side of a view: a detector sees it smaller still, and a telephone's picture in full size
# takes seconds to mirror and turn. See docs/research/start-and-memory.md.
_MOST_PX = 2048
# Level of 1 that a quarter of a bright picture exceeds, and the least power that brightens a dark
# one. Chosen on drawn films made dark, and photographs; see docs/research/raw-video.md.
_DARK, _LEAST_POWER = 0.3, 0.5


def find_both_ways(detector: Detector, frame: Frame) -> list[Candidate]:
    """The candidates of a picture and of the mirrored one, each with the mean of its two scores.

    What is seen in one of them only has a score of 0 in the other: a fish is mostly seen in both,
    other things less often (docs/research/real-pictures.md). Silhouettes are left out: a mean box
    has none.
    """
    width = frame.image.shape[1]
    image = np.ascontiguousarray(frame.image[:, ::-1])
    mirrored = [
        replace(candidate, bbox_xyxy_px=np.array([width - x1, y0, width - x0, y1]), foreground=None)
        for candidate in detector.find(replace(frame, image=image))
        for x0, y0, x1, y1 in [candidate.bbox_xyxy_px]
    ]
    found = list[Candidate]()
    for seen in detector.find(frame):
        candidate = replace(seen, foreground=None)
        same = next((other for other in mirrored if _are_same(candidate, other)), None)
        if same is None:
            found.append(replace(candidate, score=candidate.score / 2))
        else:
            mirrored.remove(same)
            box = (candidate.bbox_xyxy_px + same.bbox_xyxy_px) / 2
            score = (candidate.score + same.score) / 2
            found.append(replace(candidate, bbox_xyxy_px=box, score=score))
    return [*found, *(replace(other, score=other.score / 2) for other in mirrored)]


def shrunk(image: UInt8[np.ndarray, "H W 3"], longer_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """Area means, the longer side so long at most.

    Halves first, which is five times as fast as one step by an odd factor.
    """
    height, width = image.shape[:2]
    scale = min(1.0, longer_px / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    while image.shape[1] >= 2 * size[0] and image.shape[0] >= 2 * size[1]:
        half = (image.shape[1] // 2, image.shape[0] // 2)
        image = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
    return cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)


def brightening_power(image: UInt8[np.ndarray, "H W 3"]) -> float:
    """The power, from 0.5 to 1, of levels from 0 to 1 that brightens a dark picture; 1 if bright.

    It raises the upper quartile to 0.3, if it can: more than half of a dome's picture may be black.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(image[::8, ::8]), cv2.COLOR_BGR2GRAY)
    quartile = float(np.percentile(grey, 75).clip(1, 254)) / 255
    return min(max(math.log(_DARK) / math.log(quartile), _LEAST_POWER), 1.0)


def brightened(frame: Frame) -> Frame:
    """The frame with a dark picture brightened: fish are seen better in it."""
    power = brightening_power(frame.image)
    if power == 1:
        return frame
    levels = 255 * (np.arange(256) / 255) ** power
    return replace(frame, image=cv2.LUT(frame.image, levels.round().astype(np.uint8)))


def look_closer(detector: Detector, frame: Frame, bbox_xyxy_px: Float[np.ndarray, "4"]) -> float:
    """Mean score from 0 to 1 of a box as a fish in close views of it.

    A view in which the detector finds no such box counts as 0. Views that are larger than the frame
    continue its edges.
    """
    scores = [
        max(
            (
                found.score
                for found in find_both_ways(detector, replace(frame, image=view))
                if box_iou(found.bbox_xyxy_px, box) >= _SHOWN
            ),
            default=0.0,
        )
        for view, box in _close_views(frame.image, bbox_xyxy_px)
    ]
    return float(np.mean(scores))


def _close_views(
    image: UInt8[np.ndarray, "H W 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
) -> Iterator[tuple[UInt8[np.ndarray, "S S 3"], Float[np.ndarray, "4"]]]:
    """Square views of a box, and the box in each."""
    middle = (bbox_xyxy_px[:2] + bbox_xyxy_px[2:]) / 2
    for size, is_turned in _CLOSE_VIEWS:
        side = round(max(size * longer_side(bbox_xyxy_px), _MIN_CLOSE_PX))
        beyond = np.array(image.shape[1::-1]) - side
        corner = np.floor(middle - side / 2).clip(np.minimum(beyond, 0), np.maximum(beyond, 0))
        left, top = corner.astype(int).tolist()
        view, scale = _shrunk(_part(image, left, top, side))
        x0, y0, x1, y1 = (bbox_xyxy_px - np.tile(corner, 2)) * scale
        if is_turned:
            end = len(view)
            yield np.ascontiguousarray(np.rot90(view)), np.array([y0, end - x1, y1, end - x0])
        else:
            yield view, np.array([x0, y0, x1, y1])


def _part(
    image: UInt8[np.ndarray, "H W 3"], left: int, top: int, side: int
) -> UInt8[np.ndarray, "S S 3"]:
    """A square of a picture, whose edges go on where it is larger."""
    height, width = image.shape[:2]
    inside = image[max(top, 0) : top + side, max(left, 0) : left + side]
    above, before = max(-top, 0), max(-left, 0)
    below, behind = max(top + side - height, 0), max(left + side - width, 0)
    return cv2.copyMakeBorder(inside, above, below, before, behind, cv2.BORDER_REPLICATE)


def _shrunk(image: UInt8[np.ndarray, "H W 3"]) -> tuple[UInt8[np.ndarray, "h w 3"], float]:
    """A picture of at most `_MOST_PX`, and its size over the given one's."""
    scale = _MOST_PX / max(image.shape[:2])
    if scale >= 1:
        return image, 1.0
    size = [max(1, round(scale * side)) for side in image.shape[1::-1]]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA), scale


def find_in_view(
    detector: Detector, frame: Frame, view: UInt8[np.ndarray, "h w 3"], corner: tuple[int, int]
) -> Iterator[Candidate]:
    """The candidates in a view, whose corner is at a pixel of the frame, in the frame's pixels."""
    limits = np.tile(np.array(frame.image.shape[1::-1], np.float64), 2)
    for candidate in find_both_ways(detector, replace(frame, image=np.ascontiguousarray(view))):
        box = (candidate.bbox_xyxy_px + np.tile(corner, 2)).clip(0, limits)
        yield replace(candidate, bbox_xyxy_px=box)


def find_in_still(detector: Detector, frame: Frame) -> list[Candidate]:
    """The candidates of a picture: large ones from afar, with a rim, small ones from near.

    Each has the mean of its score there and in two close views.
    """
    small, scale = _shrunk(frame.image)
    limits = np.tile(frame.image.shape[1::-1], 2)
    found = [
        replace(fish, bbox_xyxy_px=(fish.bbox_xyxy_px / scale).clip(0, limits))
        for fish in _find_in_views(detector, replace(frame, image=small))
    ]
    least_px = _LEAST * max(frame.image.shape[:2])
    found = [
        replace(fish, score=(fish.score + 2 * look_closer(detector, frame, fish.bbox_xyxy_px)) / 3)
        for fish in found
        if fish.score >= _FAINT and longer_side(fish.bbox_xyxy_px) >= least_px
    ]
    sure = [longer_side(fish.bbox_xyxy_px) for fish in found if fish.score >= _SURE_NEAR]
    longest_px = max(sure, default=0.0)
    return [fish for fish in found if longer_side(fish.bbox_xyxy_px) >= _SHORTEST * longest_px]


def _find_in_views(detector: Detector, frame: Frame) -> list[Candidate]:
    """The candidates of a picture, of one with a rim and of its parts, each fish once."""
    height, width = frame.image.shape[:2]
    rim_px = round(_RIM * max(height, width))
    afar = cv2.copyMakeBorder(frame.image, rim_px, rim_px, rim_px, rim_px, cv2.BORDER_REPLICATE)
    large = [
        candidate
        for candidate in find_in_view(detector, frame, afar, (-rim_px, -rim_px))
        if longer_side(candidate.bbox_xyxy_px) > _LARGE * max(height, width)
    ]
    whole, others = find_both_ways(detector, frame), list[Candidate]()
    rows, columns = round(_TILE_SHARE * height), round(_TILE_SHARE * width)
    for top, left in product((0, height - rows), (0, width - columns)):
        tile = frame.image[top : top + rows, left : left + columns]
        others += [
            candidate
            for candidate in find_in_view(detector, frame, tile, (left, top))
            if candidate.score >= _SURE_NEAR
            and not _is_cut(candidate, frame, tile, (left, top))
            and not any(_is_part(candidate, fish) for fish in [*large, *whole])
        ]
    kept = [*large]
    for candidate in sorted([*whole, *others], key=lambda candidate: -candidate.score):
        if not any(_are_same(candidate, fish) for fish in kept):
            kept.append(candidate)
    return kept


def _is_part(candidate: Candidate, fish: Candidate) -> bool:
    is_inside = fraction_inside(candidate.bbox_xyxy_px, fish.bbox_xyxy_px) > _INSIDE
    return is_inside and not _are_same(candidate, fish)


def _are_same(candidate: Candidate, fish: Candidate) -> bool:
    return box_iou(candidate.bbox_xyxy_px, fish.bbox_xyxy_px) >= _SAME_FISH


def _is_cut(
    candidate: Candidate, frame: Frame, tile: UInt8[np.ndarray, "h w 3"], corner: tuple[int, int]
) -> bool:
    """True if a box reaches an edge of a tile that is none of the picture."""
    low = np.array(corner)
    high = low + tile.shape[1::-1]
    at_low = (candidate.bbox_xyxy_px[:2] < low + _EDGE_PX) & (low > 0)
    at_high = (candidate.bbox_xyxy_px[2:] > high - _EDGE_PX) & (high < frame.image.shape[1::-1])
    return bool(at_low.any() or at_high.any())
