"""Find fish in parts of a picture and in a wider picture, in the pixels of the picture itself."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
from jaxtyping import UInt8

from stream_dmr.detection.detector import Candidate, Detector
from stream_dmr.geometry import box_iou, fraction_inside, longer_side
from stream_dmr.messages import Frame

# A detector misses small fish, and fish that fill the picture or their tails. Chosen on photographs
# that it never saw; see docs/research/real-pictures.md.
_RIM = 0.25  # of the picture's longer side, around it
_LARGE = 0.4  # of the picture's longer side: fish that are taken from the picture with the rim
_TILE_SHARE = 0.625  # of the picture's sides: two by two overlap by a quarter of the picture
_EDGE_PX = 3  # from a tile's edge: a box so near may be cut
_SURE_NEAR = 0.45  # least score in a tile, where parts of other things look like fish
_SAME_FISH, _INSIDE = 0.45, 0.9  # IoU of two boxes of a fish; share of a part in the fish's box
# Share of the longest fish in the picture: shorter finds are dirt, scales or leaves beside it, and
# only their size shows it. See docs/research/real-lengths.md.
_SHORTEST = 0.1


def find_both_ways(detector: Detector, frame: Frame) -> list[Candidate]:
    """The candidates of a picture and of the mirrored one, each with the mean of its two scores.

    What is seen in one of them only has a score of 0 in the other: a fish is mostly seen in both,
    other things less often (docs/research/real-pictures.md).
    """
    width = frame.image.shape[1]
    image = np.ascontiguousarray(frame.image[:, ::-1])
    mirrored = [
        replace(candidate, bbox_xyxy_px=np.array([width - x1, y0, width - x0, y1]))
        for candidate in detector.find(replace(frame, image=image))
        for x0, y0, x1, y1 in [candidate.bbox_xyxy_px]
    ]
    found = list[Candidate]()
    for candidate in detector.find(frame):
        same = next((other for other in mirrored if _are_same(candidate, other)), None)
        if same is None:
            found.append(replace(candidate, score=candidate.score / 2))
        else:
            mirrored.remove(same)
            box = (candidate.bbox_xyxy_px + same.bbox_xyxy_px) / 2
            score = (candidate.score + same.score) / 2
            found.append(replace(candidate, bbox_xyxy_px=box, score=score))
    return [*found, *(replace(other, score=other.score / 2) for other in mirrored)]


def find_in_view(
    detector: Detector, frame: Frame, view: UInt8[np.ndarray, "h w 3"], corner: tuple[int, int]
) -> Iterator[Candidate]:
    """The candidates in a view, whose corner is at a pixel of the frame, in the frame's pixels."""
    limits = np.tile(np.array(frame.image.shape[1::-1], np.float64), 2)
    for candidate in find_both_ways(detector, replace(frame, image=np.ascontiguousarray(view))):
        box = (candidate.bbox_xyxy_px + np.tile(corner, 2)).clip(0, limits)
        yield replace(candidate, bbox_xyxy_px=box)


def find_in_still(detector: Detector, frame: Frame) -> list[Candidate]:
    """The candidates of a picture: large ones from afar, with a rim, small ones from near."""
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
    sure = [longer_side(fish.bbox_xyxy_px) for fish in kept if fish.score >= _SURE_NEAR]
    longest_px = max(sure, default=0.0)
    return [fish for fish in kept if longer_side(fish.bbox_xyxy_px) >= _SHORTEST * longest_px]


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
