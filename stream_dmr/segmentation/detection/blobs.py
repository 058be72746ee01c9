"""Which of the moving shapes in a picture may be fish: not the line, nor a gaff reaching in."""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

_POLE = 1 / 50  # of the longer side: what is thinner all along may be a gaff or a line
_BODY = 3.0  # squares of a pole's width: a smaller thick part is a knee of something thin
_TAIL = 0.35  # of its body's length that a fish's tail and snout may add
_THICKNESS = 0.06  # of its length: fish seen edge-on are thicker on average
_FEW_PX = 3.5


def fish_shapes(
    moving: Bool[np.ndarray, "H W"], *, min_length_px: float, max_length_px: float
) -> list[Bool[np.ndarray, "H W"]]:
    """The connected shapes that may be fish, rid of poles and lines that they hang together with.

    A thin shape that reaches the edge of the picture is a pole or a line; a thin one inside may be
    a fish seen edge-on.
    """
    pole = max(3, round(_POLE * max(moving.shape))) | 1
    shapes = []
    for shape in _components(moving):
        shape = _without_poles(shape, pole)
        if shape is not None and _may_be_fish(shape, min_length_px, max_length_px):
            shapes.append(shape)
    return shapes


def _components(mask: Bool[np.ndarray, "H W"]) -> Iterator[Bool[np.ndarray, "H W"]]:
    count, labels, _, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    for label in range(1, count):
        yield labels == label


def _without_poles(shape: Bool[np.ndarray, "H W"], pole_px: int) -> Bool[np.ndarray, "H W"] | None:
    """The thick part of a shape with what a fish's ends may add; None where only a pole is."""
    x, y, w, h = cv2.boundingRect(shape.view(np.uint8))
    part = np.pad(shape[y : y + h, x : x + w], pole_px).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (pole_px, pole_px))
    body = cv2.morphologyEx(part, cv2.MORPH_OPEN, kernel)
    body = _largest(body)
    if np.count_nonzero(body) < _BODY * pole_px**2:
        height, width = shape.shape
        touches = min(x, y, width - x - w, height - y - h) <= 1
        return None if touches else shape
    reach = round(_TAIL * max(cv2.boundingRect(body)[2:]))
    if max(w, h) <= max(cv2.boundingRect(body)[2:]) + reach:
        return shape
    for _ in range(max(1, reach // 2)):  # grow within the shape: back to the ends, no further
        body = cv2.bitwise_and(cv2.dilate(body, np.ones((3, 3), np.uint8)), part)
    fish = np.zeros_like(shape)
    fish[y : y + h, x : x + w] = body[pole_px:-pole_px, pole_px:-pole_px] > 0
    return fish


def _largest(mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    if count < 3:
        return mask
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    return (labels == largest).astype(np.uint8)


def _may_be_fish(
    shape: Bool[np.ndarray, "H W"], min_length_px: float, max_length_px: float
) -> bool:
    points = cv2.findNonZero(shape.view(np.uint8))
    length = max(cv2.minAreaRect(points)[1]) + 1
    thickness = len(points) / length
    return min_length_px <= length <= max_length_px and thickness >= max(
        _THICKNESS * length, _FEW_PX
    )
