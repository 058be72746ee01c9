"""Convert masks to and from the formats of other programs: polygons and COCO's run lengths.

Their coordinates are from the corner of the picture, so a pixel's centre is at one half.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.errors import AnnotationError

Ring = Float[np.ndarray, "_ 2"]  # corners x, y of a polygon, in px from the picture's corner
Part = Sequence[Ring]
"""One connected part of a mask: its outline, then those of its holes."""

# Lines between the middles of pixel edges pass no pixel's centre by less than sqrt(1/8) px; 0.1 px
# are left for the rounding of other programs, so that each pixel stays inside or outside.
_TOLERANCE_PX = 0.25
_MAX_CORNER_PX = 1e6  # chosen: beyond every camera's picture
_ON_LINE_PX = 0.01  # a pixel whose centre is so near to a line is inside


def outlines_of(mask: Bool[np.ndarray, "H W"]) -> list[Part]:
    """Polygons with few corners from which `fill_parts` makes the same mask; the largest first."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    # At double size, the parity of a border pixel shows on which side of it the border is.
    doubled = mask[y : y + height, x : x + width].astype(np.uint8).repeat(2, 0).repeat(2, 1)
    lines, tree = cv2.findContours(doubled, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    parts = dict[int, list[Ring]]()
    for i in sorted(range(len(lines)), key=lambda i: tree[0, i, 3] >= 0):  # outlines before holes
        corners = (lines[i][:, 0] + 1) // 2 + [x, y]
        corners = corners[(corners != np.roll(corners, 1, axis=0)).any(axis=1)]
        middles = ((corners + np.roll(corners, -1, axis=0)) / 2).astype(np.float32)
        ring = cv2.approxPolyDP(middles, _TOLERANCE_PX, closed=True)[:, 0].astype(np.float64)
        parts.setdefault(int(tree[0, i, 3]) if tree[0, i, 3] >= 0 else i, []).append(ring)
    return sorted(parts.values(), key=lambda part: -cv2.contourArea(part[0].astype(np.float32)))


def fill_parts(shape: tuple[int, int], parts: Sequence[Part]) -> Bool[np.ndarray, "H W"]:
    """The mask of all pixels of a picture whose centres are inside, or on a line.

    So it reads outlines along the edges of pixels as well as outlines through the centres of the
    border pixels, which OpenCV gives.
    """
    mask, on_line = np.zeros(shape, bool), (-_ON_LINE_PX, _ON_LINE_PX)
    for part in parts:
        corners = np.concatenate(part)
        low = np.floor(corners.min(axis=0) - 1).clip(0, shape[::-1]).astype(int)
        high = np.ceil(corners.max(axis=0) + 1).clip(low, shape[::-1]).astype(int)
        window = mask[low[1] : high[1], low[0] : high[0]]
        for shift in ((dx, dy) for dx in on_line for dy in on_line):
            window |= _between([ring - low + shift for ring in part], window.shape)
    return mask


def _between(rings: Part, shape: tuple[int, ...]) -> Bool[np.ndarray, "H W"]:
    """Pixels with an odd number of lines to the left of their centres."""
    crossings = np.zeros((shape[0], shape[1] + 1), np.uint8)
    for ring in rings:
        (x0, y0), (x1, y1) = ring.T, np.roll(ring, -1, axis=0).T
        first, last = (
            np.ceil(y - 0.5).clip(0, shape[0]).astype(int)
            for y in (np.minimum(y0, y1), np.maximum(y0, y1))
        )
        count = last - first
        line = np.repeat(np.arange(len(ring)), count)
        row = np.arange(len(line)) + (first - np.cumsum(count) + count)[line]
        along = (row + 0.5 - y0[line]) / (y1 - y0)[line]
        x = x0[line] + along * (x1 - x0)[line]
        np.add.at(crossings, (row, np.ceil(x - 0.5).clip(0, shape[1]).astype(int)), 1)
    return np.bitwise_xor.accumulate(crossings & 1, axis=1)[:, :-1] > 0


def run_lengths(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """COCO's counts: pixels off, on, off, ... column by column, beginning with pixels off."""
    pixels = mask.ravel(order="F")
    changes = np.flatnonzero(np.diff(pixels)) + 1
    edges = np.concatenate([[0], changes, [len(pixels)]])
    counts = np.diff(edges).tolist()
    return [0, *counts] if pixels[0] else counts


def ring_of(numbers: Any, *, where: str) -> Ring:
    """The corners of a polygon that a file gives as x, y, x, y, ...

    Raises AnnotationError, about the place `where`, for corners far from any picture, with which
    the arithmetic would overflow; ValueError and TypeError if it is no list of corners.
    """
    ring = np.asarray_chkfinite(numbers, np.float64).reshape(-1, 2)
    if (far := np.abs(ring).max(initial=0.0)) > _MAX_CORNER_PX:
        raise AnnotationError(
            f"{where}: expected corners of polygons within {_MAX_CORNER_PX:g} px, got one at "
            f"{far:g} px; correct it"
        )
    return ring


def decode_coco(
    shape: tuple[int, int], segmentation: Any, *, where: str
) -> Bool[np.ndarray, "H W"]:
    """The mask of COCO's `segmentation`, polygons or run lengths, in a picture of a shape.

    Raises AnnotationError, about the place `where`, for another size or another format.
    """
    try:
        if not isinstance(segmentation, dict):
            rings = [[ring_of(polygon, where=where)] for polygon in segmentation]
            return fill_parts(shape, rings)
        counts = segmentation["counts"]
        runs = _unpack(counts) if isinstance(counts, str) else counts
        if sum(runs) == shape[0] * shape[1] and list(segmentation["size"]) == list(shape):
            values = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
            return np.ascontiguousarray(values.reshape(shape[::-1]).T)
    except (ValueError, TypeError, KeyError):
        raise AnnotationError(
            f"{where}: expected polygons or run lengths, got something else"
        ) from None
    raise AnnotationError(
        f"{where}: expected a mask of {shape[1]}x{shape[0]} px, got one of another size"
    )


def require_size(image: Mapping[str, Any], shape: tuple[int, int], *, where: str) -> None:
    """Raise AnnotationError if the `image` of a file says another size than the picture's shape.

    Its boxes and polygons are then of another scale, or of a picture that was turned.
    """
    said = image.get("width"), image.get("height")
    if all(isinstance(n, int | float) and n > 0 for n in said) and said != (shape[1], shape[0]):
        raise AnnotationError(
            f"{where}: expected annotations of a picture of {shape[1]}x{shape[0]} px, got those of "
            f"{said[0]}x{said[1]} px; annotate the pictures as they are"
        )


def _unpack(text: str) -> list[int]:
    """COCO's compressed run lengths: 5 bits a character, differences to the last run but one.

    After `rleFrString` of the COCO API (github.com/cocodataset/cocoapi, common/maskApi.c).
    """
    runs: list[int] = []
    value = shift = 0
    for byte in text.encode("ascii"):
        bits = byte - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    return runs
