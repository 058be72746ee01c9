"""Boxes as the network sees them, and the square crop around a box."""

import numpy as np
from jaxtyping import Float, Float32


def box_picture(bbox_xyxy_px: Float[np.ndarray, "4"], *, size: int) -> Float32[np.ndarray, "S S"]:
    """How much of each pixel lies in the box, 0 to 1; the box is half-open, in crop pixels."""
    starts = np.arange(size)
    x0, y0, x1, y1 = bbox_xyxy_px
    columns = np.clip(np.minimum(starts + 1, x1) - np.maximum(starts, x0), 0.0, 1.0)
    rows = np.clip(np.minimum(starts + 1, y1) - np.maximum(starts, y0), 0.0, 1.0)
    return np.outer(rows, columns).astype(np.float32)


def crop_around(
    bbox_xyxy: Float[np.ndarray, "4"], *, margin: float, size: int
) -> Float[np.ndarray, "2 3"]:
    """The map from points to pixels (centres at integers) of a square crop around a box.

    `margin` is the room on each side, as a fraction of the box's longer side.
    """
    low, high = bbox_xyxy[:2], bbox_xyxy[2:]
    scale = size / (max(float((high - low).max()), 1e-6) * (1 + 2 * margin))
    shift = (size - 1) / 2 - scale * (low + high) / 2
    return np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])


def jitter(
    rng: np.random.Generator,
    bbox_xyxy: Float[np.ndarray, "4"],
    *,
    limits: Float[np.ndarray, "4"],
) -> Float[np.ndarray, "4"]:
    """A box drawn as people and detectors do: some per cent off, one in three by much more.

    Detectors lose thin tails, and take a piece of line or gaff for a part of the fish.
    """
    low, high = bbox_xyxy[:2], bbox_xyxy[2:]
    sides = np.tile(high - low, 2)
    spread = 0.10 if rng.random() < 0.12 else rng.uniform(0.0, 0.04)
    moved = bbox_xyxy + sides * rng.laplace(0.0, spread / np.sqrt(2), 4).clip(-0.2, 0.2)
    if rng.random() < 0.25:
        edge, outwards = rng.integers(4), rng.uniform(-0.25, 0.5)
        reach = outwards * (sides.max() if outwards > 0 else sides[edge])
        moved[edge] += reach if edge >= 2 else -reach
    return np.clip(moved, np.tile(limits[:2], 2), np.tile(limits[2:], 2))
