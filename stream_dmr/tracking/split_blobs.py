"""Split a moving blob that several fish share, by where each fish is predicted to be.

Motion blobs merge long before fish hide each other. A fish hardly changes from one frame to the
next, so the pixels under its last silhouette, moved to the predicted position, are its own. A
remainder as large as a fish is another fish, even if it was never seen before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stream_dmr.detection.detector import Candidate
from stream_dmr.geometry import components, oriented_extent, whole_pixels

# Chosen on simulated scenes (seeds 900 to 903) and crossings; see docs/research/tracking.md.
_MIN_VISIBLE_FRACTION = 0.6  # of a predicted silhouette inside the blob; below, the fish is absent
_MATCH_RADIUS = 0.1  # fish lengths between a pixel and the predicted silhouette that it belongs to
_MIN_MATCH_RADIUS_PX = 2.0
_MIN_AREA_RATIO = 0.3  # of the smallest fish's area; smaller pieces are dropped
_MAX_LENGTH_RATIO = 1.3  # of the fish's length; a longer blob may be several fish
_MAX_WIDTH_RATIO = 0.6  # blob width over fish length, likewise; no fish turns as wide
_LINE_WIDTH_RATIO = 0.06  # of the shortest fish's length; thinner parts are lines or slivers


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PredictedSilhouette:
    """A fish's last silhouette at its predicted position, and its known size."""

    shape: Bool[np.ndarray, "h w"]
    corner: Float[np.ndarray, "2"]  # frame x, y of its first pixel
    length_px: float
    area_px: float
    is_whole: bool  # the fish was seen separately, so its size is known


def split_merged_blob(
    candidate: Candidate, known: Sequence[PredictedSilhouette]
) -> list[Candidate]:
    """The candidate's pieces: one per visible fish, then the pieces that no known fish explains.

    `[candidate]` if it has no `foreground`, or if fewer than two pieces are large enough.
    """
    if candidate.foreground is None:
        return [candidate]
    x, y, _, _ = whole_pixels(candidate.bbox_xyxy_px)
    foreground = candidate.foreground
    fish, regions = list[PredictedSilhouette](), list[Bool[np.ndarray, "H W"]]()
    for silhouette in known:
        region = _in_region(silhouette, foreground.shape, (x, y))
        visible_px = np.count_nonzero(foreground & region)
        if visible_px / max(np.count_nonzero(silhouette.shape), 1) > _MIN_VISIBLE_FRACTION:
            fish.append(silhouette)
            regions.append(region)
    if not fish or (len(fish) == 1 and not _may_be_several(foreground, fish[0])):
        return [candidate]
    distances = np.stack([_distance_px(region) for region in regions])
    nearest = distances.argmin(axis=0)
    radii = [max(_MIN_MATCH_RADIUS_PX, _MATCH_RADIUS * single.length_px) for single in fish]
    is_near = distances.min(axis=0) <= np.array(radii)[nearest]
    line_px = round(_LINE_WIDTH_RATIO * min(single.length_px for single in fish)) | 1
    owned = [foreground & is_near & (nearest == i) for i in range(len(fish))]
    parts = [_components(_opened(region, line_px)) for region in owned]
    pieces = [max(own, key=np.count_nonzero) for own in parts if own]
    pieces += _components(_opened(foreground & ~is_near, line_px))
    min_area = _MIN_AREA_RATIO * min(single.area_px for single in fish)
    pieces = [piece for piece in pieces if np.count_nonzero(piece) >= min_area]
    if len(pieces) < 2:
        return [candidate]
    return [_piece(piece, candidate, (x, y)) for piece in pieces]


def _may_be_several(blob: Bool[np.ndarray, "H W"], fish: PredictedSilhouette) -> bool:
    """True if a blob is too long or too wide for this fish; turning only widens a fish."""
    if not fish.is_whole:
        return False
    width_px, length_px = oriented_extent(blob)
    return (
        length_px > _MAX_LENGTH_RATIO * fish.length_px
        or width_px > _MAX_WIDTH_RATIO * fish.length_px
    )


def _distance_px(silhouette: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Distance of each pixel from a silhouette, px."""
    outside = (~silhouette).astype(np.uint8)
    return cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_3).astype(np.float64)


def _in_region(
    fish: PredictedSilhouette, shape: tuple[int, ...], corner: tuple[int, int]
) -> Bool[np.ndarray, "H W"]:
    """The predicted silhouette in the pixels of a region, which begins at `corner`."""
    placed = np.zeros(shape, bool)
    x, y = np.round(fish.corner - corner).astype(int).tolist()
    top, left = max(0, y), max(0, x)
    inside = fish.shape[max(-y, 0) : max(shape[0] - y, 0), max(-x, 0) : max(shape[1] - x, 0)]
    placed[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    return placed


def _opened(mask: Bool[np.ndarray, "H W"], diameter_px: int) -> UInt8[np.ndarray, "H W"]:
    """Morphological opening: removes what is thinner than a disc of this diameter."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter_px, diameter_px))
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc)


def _components(mask: UInt8[np.ndarray, "H W"]) -> list[Bool[np.ndarray, "H W"]]:
    count, labels, _ = components(mask)
    return [labels == label for label in range(1, count)]


def _piece(piece: Bool[np.ndarray, "H W"], whole: Candidate, corner: tuple[int, int]) -> Candidate:
    x, y, w, h = cv2.boundingRect(piece.view(np.uint8))
    box = np.array([x, y, x + w, y + h], np.float64) + np.tile(corner, 2)
    place = whole.place_px
    if place is not None:
        place = place + (box.reshape(2, 2) - whole.bbox_xyxy_px.reshape(2, 2)).mean(axis=0)
    foreground = piece[y : y + h, x : x + w].copy()
    return replace(whole, bbox_xyxy_px=box, foreground=foreground, place_px=place)
