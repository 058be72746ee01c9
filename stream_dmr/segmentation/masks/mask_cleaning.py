"""Remove noise from a mask: small parts and pinholes."""

import cv2
import numpy as np
from jaxtyping import Bool

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
    parts, areas = _components(region, connectivity=8)
    is_part = areas >= _MIN_PART_RATIO * areas.max()
    if not is_part[1:].all():
        region = is_part[parts] & region
    # Padding makes the background one component, that of pixel (0, 0); all others are holes.
    gaps, areas = _components(~np.pad(region, 1), connectivity=4)
    is_hole = areas < _MAX_HOLE_RATIO * np.count_nonzero(region)
    is_hole[[0, gaps[0, 0]]] = False
    if is_hole.any():
        region = region | is_hole[gaps][1:-1, 1:-1]
    if np.count_nonzero(region) >= min_area_px:
        cleaned[y : y + height, x : x + width] = region
    return cleaned


def _components(
    mask: Bool[np.ndarray, "H W"], *, connectivity: int
) -> tuple[np.ndarray, np.ndarray]:
    """Labels (H, W) of the connected components, 0 outside, and each label's area (0: zero)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=connectivity
    )
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return labels, areas
