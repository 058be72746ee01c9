"""Square crops around boxes, and boxes with the errors that annotators and detectors make."""

import numpy as np
from jaxtyping import Float


def crop_affine(
    bbox_xyxy: Float[np.ndarray, "4"], *, margin: float, size: int
) -> Float[np.ndarray, "2 3"]:
    """The affine map from points to pixels (centers at integers) of a square crop around a box.

    `margin` is the room on each side, as a fraction of the box's longer side; `size` in px.
    """
    low, high = bbox_xyxy[:2], bbox_xyxy[2:]
    scale = size / (max(float((high - low).max()), 1e-6) * (1 + 2 * margin))
    shift = (size - 1) / 2 - scale * (low + high) / 2
    return np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])


def jitter_box(
    rng: np.random.Generator,
    bbox_xyxy: Float[np.ndarray, "4"],
    *,
    limits: Float[np.ndarray, "4"],
) -> Float[np.ndarray, "4"]:
    """A box with random errors, clipped to `limits`: some per cent, for one box in three far more.

    Detectors miss thin tails, and include pieces of line or gaff.
    """
    low, high = bbox_xyxy[:2], bbox_xyxy[2:]
    sides = np.tile(high - low, 2)
    spread = 0.10 if rng.random() < 0.12 else rng.uniform(0.0, 0.04)
    moved = bbox_xyxy + sides * rng.laplace(0.0, spread / np.sqrt(2), 4).clip(-0.2, 0.2)
    if rng.random() < 0.25:
        edge, outwards = rng.integers(4), rng.uniform(-0.25, 0.5)
        offset = outwards * (sides.max() if outwards > 0 else sides[edge])
        moved[edge] += offset if edge >= 2 else -offset
    return np.clip(moved, np.tile(limits[:2], 2), np.tile(limits[2:], 2))


def draw_part_box(
    rng: np.random.Generator,
    bbox_xyxy: Float[np.ndarray, "4"],
    points: Float[np.ndarray, "N 2"],
) -> Float[np.ndarray, "4"]:
    """A box within a box, with 25 to 60 % of its sides, around one of the points as far as it fits.

    Blobs of motion often cover a fin or half a body of a large fish only.
    """
    low, high = bbox_xyxy[:2], bbox_xyxy[2:]
    sides = rng.uniform(0.25, 0.6, 2) * (high - low)
    corner = np.clip(points[rng.integers(len(points))] - sides / 2, low, high - sides)
    return np.concatenate([corner, corner + sides])
