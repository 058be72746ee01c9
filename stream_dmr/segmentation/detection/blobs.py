"""Select the moving blobs that may be fish, without the lines and gaffs connected to them."""

import math
from collections import Counter
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from stream_dmr.segmentation.detection.components import components

# Chosen on simulated scenes (seeds 900 to 903) and the trout clip; see docs/research/raw-video.md.
_POLE_WIDTH = 1 / 50  # of the longer side; what is thinner throughout may be a gaff or a line
_MIN_BODY_AREA = 3.0  # pole widths squared; a smaller thick part is a bend of a thin object
_MIN_BODY_RATIO = 0.3  # of the largest thick part; smaller ones are fins and hooks
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
    count, labels, stats = components(moving.view(np.uint8))
    height, width = moving.shape
    for label in range(1, count):
        x, y, w, h, area = stats[label].tolist()
        touches_edge = min(x, y, width - x - w, height - y - h) <= 1
        if area < _MIN_BODY_AREA * pole_px**2 and math.hypot(w - 1, h - 1) + 1 < min_length_px:
            # Most of what moves is such specks; the rest would come to the same, by opening them.
            refused[Refusal.THIN if touches_edge else Refusal.SHORT] += 1
            continue
        part = np.s_[y : y + h, x : x + w]
        blobs = _without_poles(labels[part] == label, pole_px, touches_edge=touches_edge)
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
    blob: Bool[np.ndarray, "h w"], pole_px: int, *, touches_edge: bool
) -> list[Bool[np.ndarray, "h w"]]:
    """The thick parts of a blob, each with a fish's thin ends; none for a mere pole or line.

    Two thick parts that only a thin bridge joins are two fish that touch each other.
    """
    region = np.pad(blob, pole_px).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (pole_px, pole_px))
    bodies = _bodies(cv2.morphologyEx(region, cv2.MORPH_OPEN, kernel), _MIN_BODY_AREA * pole_px**2)
    if not bodies:
        return [] if touches_edge else [blob]
    body_px = [max(cv2.boundingRect(body)[2:]) for body in bodies]
    if len(bodies) == 1 and max(blob.shape) <= body_px[0] + round(_MAX_END_LENGTH * body_px[0]):
        return [blob]
    fish = _with_ends(bodies, [round(_MAX_END_LENGTH * px) for px in body_px], region)
    return [one[pole_px:-pole_px, pole_px:-pole_px] > 0 for one in fish]


def _bodies(opened: UInt8[np.ndarray, "h w"], min_area_px: float) -> list[UInt8[np.ndarray, "h w"]]:
    """The largest component, and those that are nearly as large; a tail fin is not."""
    count, labels, stats = components(opened)
    areas = stats[1:, cv2.CC_STAT_AREA]
    least = max(min_area_px, _MIN_BODY_RATIO * max(areas, default=0))
    return [(labels == i).astype(np.uint8) for i in range(1, count) if areas[i - 1] >= least]


def _with_ends(
    bodies: list[UInt8[np.ndarray, "h w"]], ends_px: list[int], region: UInt8[np.ndarray, "h w"]
) -> list[UInt8[np.ndarray, "h w"]]:
    """Bodies grown within a region, back to the ends and no further, each before the others."""
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
    return grown


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
