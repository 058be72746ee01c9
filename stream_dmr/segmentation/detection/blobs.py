"""Select the moving blobs that may be fish, without the lines and gaffs connected to them."""

import math
from collections import Counter
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

# Chosen on simulated scenes (seeds 900 to 903) and the trout clip; see docs/research/raw-video.md.
_POLE_WIDTH = 1 / 50  # of the longer side; what is thinner throughout may be a gaff or a line
_MIN_BODY_AREA = 3.0  # pole widths squared; a smaller thick part is a bend of a thin object
_MAX_END_LENGTH = 0.35  # of the thick part's length, that tail and snout may add
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

    A thin component that reaches the edge of the picture is a pole or a line; a thin one inside may
    be a fish seen edge-on. Also how many components were refused, by reason.
    """
    pole_px = max(3, round(_POLE_WIDTH * max(moving.shape))) | 1
    fish, refused = [], Counter[Refusal]()
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moving.view(np.uint8))
    height, width = moving.shape
    for label in range(1, count):
        x, y, w, h, area = stats[label].tolist()
        touches_edge = min(x, y, width - x - w, height - y - h) <= 1
        if area < _MIN_BODY_AREA * pole_px**2 and math.hypot(w - 1, h - 1) + 1 < min_length_px:
            # Most of what moves is such specks; the rest would come to the same, by opening them.
            refused[Refusal.THIN if touches_edge else Refusal.SHORT] += 1
            continue
        part = np.s_[y : y + h, x : x + w]
        blob = _without_poles(labels[part] == label, pole_px, touches_edge=touches_edge)
        refusal = Refusal.THIN
        if blob is not None:
            refusal = _refusal(blob, min_length_px, max_length_px)
        if blob is not None and refusal is None:
            shape = np.zeros_like(moving)
            shape[part] = blob
            fish.append(shape)
        elif refusal is not None:
            refused[refusal] += 1
    return fish, refused


def _without_poles(
    blob: Bool[np.ndarray, "h w"], pole_px: int, *, touches_edge: bool
) -> Bool[np.ndarray, "h w"] | None:
    """The thick part of a blob with a fish's thin ends; None for a mere pole or line."""
    region = np.pad(blob, pole_px).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (pole_px, pole_px))
    body = _largest_component(cv2.morphologyEx(region, cv2.MORPH_OPEN, kernel))
    if np.count_nonzero(body) < _MIN_BODY_AREA * pole_px**2:
        return None if touches_edge else blob
    body_px = max(cv2.boundingRect(body)[2:])
    end_px = round(_MAX_END_LENGTH * body_px)
    if max(blob.shape) <= body_px + end_px:
        return blob
    for _ in range(max(1, end_px // 2)):  # grow within the blob: back to the ends, no further
        body = cv2.bitwise_and(cv2.dilate(body, np.ones((3, 3), np.uint8)), region)
    return body[pole_px:-pole_px, pole_px:-pole_px] > 0


def _largest_component(mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    if count < 3:
        return mask
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    return (labels == largest).astype(np.uint8)


def _refusal(
    blob: Bool[np.ndarray, "h w"], min_length_px: float, max_length_px: float
) -> Refusal | None:
    """None where length and mean thickness (area over length) are those of a fish."""
    points = cv2.findNonZero(blob.view(np.uint8))
    length_px = max(cv2.minAreaRect(points)[1]) + 1
    if length_px < min_length_px:
        return Refusal.SHORT
    if length_px > max_length_px:
        return Refusal.LONG
    min_thickness_px = max(_MIN_THICKNESS * length_px, _MIN_THICKNESS_PX)
    return None if len(points) / length_px >= min_thickness_px else Refusal.THIN
