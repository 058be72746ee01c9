"""Remove noise from a mask: small parts and pinholes."""

import cv2
import numpy as np
from jaxtyping import Bool

from stream_dmr.segmentation.detection.components import components

# Chosen by hand.
_MIN_PART_RATIO = 0.05  # of the largest part's area: a tail behind a gaff stays, specks go
_MAX_HOLE_RATIO = 0.01  # of the mask's area: pinholes are noise, larger ones an object in front


def clean_mask(mask: Bool[np.ndarray, "H W"], *, min_area_px: int) -> Bool[np.ndarray, "H W"]:
    """The mask without small parts and pinholes; empty if it is smaller than `min_area_px`.

    Parts below 5 % of the largest part's area go, so that a fish cut in two by a line or a gaff
    keeps both halves; holes below 1 % of the mask's area are filled, larger ones stay.
    """
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    cleaned = np.zeros_like(mask)
    if width == 0:
        return cleaned
    region = mask[y : y + height, x : x + width]
    _, parts, stats = components(region.astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA]
    is_part = np.append(False, areas[1:] >= _MIN_PART_RATIO * areas[1:].max())
    if not is_part[1:].all():
        region = is_part[parts]
    region = _without_pinholes(region)
    if np.count_nonzero(region) >= min_area_px:
        cleaned[y : y + height, x : x + width] = region
    return cleaned


def _without_pinholes(region: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    # Padding makes the background one component, that of pixel (0, 0); all others are holes.
    outside = cv2.copyMakeBorder(
        (~region).view(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(1,)
    )
    count, labels = cv2.connectedComponents(outside, connectivity=4)
    if count == 2:  # none, as mostly; to measure them takes ten times as long
        return region
    gaps = np.asarray(labels, np.int32)
    areas = np.bincount(gaps.ravel())
    is_hole = areas < _MAX_HOLE_RATIO * np.count_nonzero(region)
    is_hole[[0, gaps[0, 0]]] = False
    return region | is_hole[gaps][1:-1, 1:-1]
