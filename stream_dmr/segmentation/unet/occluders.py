"""What comes between the camera and a fish: poles, gloves, ropes, edges, lines.

Everything is a set of polygons in scene units (one is the fish's length, the fish in the middle),
so that it can be drawn into any crop.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, Float32

_SUBPIXEL = 4  # bits of OpenCV's `shift`


@dataclass(frozen=True, eq=False, kw_only=True)
class Occluder:
    """Opaque shapes of one colour."""

    polygons: list[Float[np.ndarray, "_ 2"]]  # scene units
    colour: Float[np.ndarray, "3"]  # BGR
    hides: bool  # its pixels are not fish; a line is too thin for that


def draw_occluders(rng: np.random.Generator) -> list[Occluder]:
    """None for most fish, else one or two."""
    chances = {_draw_pole: 0.18, _draw_glove: 0.10, _draw_rope: 0.06, _draw_edge: 0.05}
    return [draw(rng) for draw, chance in chances.items() if rng.random() < chance]


def draw_line(rng: np.random.Generator, start: Float[np.ndarray, "2"]) -> Occluder:
    """A fishing line from here up, out of sight."""
    angle = np.radians(rng.normal(-90.0, 12.0))
    end = start + 3.0 * np.array([np.cos(angle), np.sin(angle)])
    width = rng.uniform(0.004, 0.02)
    shade = rng.uniform(20, 245) * rng.uniform(0.85, 1.15, 3)
    return Occluder(polygons=[_bar(start, end, width, width)], colour=shade, hides=False)


def coverage(
    occluder: Occluder, crop_from_scene: Float[np.ndarray, "2 3"], *, size: int
) -> Float32[np.ndarray, "S S"]:
    """How much of each crop pixel it covers, 0 to 1."""
    canvas = np.zeros((size, size), np.uint8)
    for polygon in occluder.polygons:
        points = polygon @ crop_from_scene[:, :2].T + crop_from_scene[:, 2]
        fixed = np.round(np.clip(points, -2000, 2000) * (1 << _SUBPIXEL)).astype(np.int32)
        cv2.fillPoly(canvas, [fixed], 255, cv2.LINE_AA, _SUBPIXEL)
    return canvas.astype(np.float32) / np.float32(255)


def _draw_pole(rng: np.random.Generator) -> Occluder:
    """A gaff: a pole whose hook lies somewhere on the fish."""
    tip = rng.normal(0.0, 0.2, 2)
    angle = rng.uniform(0.0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    width = rng.uniform(0.02, 0.09)
    polygons = [_bar(tip, tip + 3.0 * along, width, width * rng.uniform(1.0, 1.3))]
    if rng.random() < 0.7:
        turns = angle + np.pi + np.linspace(-0.4, 2.6, 9) * rng.choice([-1.0, 1.0])
        arc = tip + rng.uniform(0.04, 0.09) * np.column_stack([np.cos(turns), np.sin(turns)])
        arc = arc - arc[0] + tip
        polygons += [_bar(a, b, 0.3 * width, 0.3 * width) for a, b in pairwise(arc)]
    return Occluder(polygons=polygons, colour=_colour(rng), hides=True)


def _draw_glove(rng: np.random.Generator) -> Occluder:
    """A hand that holds the fish: an arm, a palm, three to five fingers."""
    palm = rng.normal(0.0, 0.28, 2)
    angle = rng.uniform(0.0, 2 * np.pi)
    size = rng.uniform(0.06, 0.16)
    arm = palm + 3.0 * np.array([np.cos(angle), np.sin(angle)])
    polygons = [_bar(palm, arm, 1.5 * size, 2.2 * size), _blob(rng, palm, size)]
    for spread in np.linspace(-0.9, 0.9, rng.integers(3, 6)):
        bend = angle + np.pi + spread + rng.normal(0.0, 0.1)
        tip = palm + rng.uniform(1.2, 2.4) * size * np.array([np.cos(bend), np.sin(bend)])
        polygons.append(_bar(palm, tip, 0.55 * size, 0.4 * size))
    return Occluder(polygons=polygons, colour=_colour(rng), hides=True)


def _draw_rope(rng: np.random.Generator) -> Occluder:
    middle, angle = rng.normal(0.0, 0.3, 2), rng.uniform(0.0, np.pi)
    reach = 3.0 * np.array([np.cos(angle), np.sin(angle)])
    width = rng.uniform(0.03, 0.08)
    rope = _bar(middle - reach, middle + reach, width, width)
    return Occluder(polygons=[rope], colour=_colour(rng), hides=True)


def _draw_edge(rng: np.random.Generator) -> Occluder:
    """A rail, a crate or a shoulder that covers one side."""
    angle = rng.uniform(0.0, 2 * np.pi)
    out = np.array([np.cos(angle), np.sin(angle)])
    near = out * rng.uniform(0.05, 0.5)
    return Occluder(
        polygons=[_bar(near, near + 3.0 * out, 5.0, 5.0)], colour=_colour(rng), hides=True
    )


def _bar(
    start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], width: float, end_width: float
) -> Float[np.ndarray, "_ 2"]:
    """A bar with half-round ends."""
    along = (end - start) / (np.linalg.norm(end - start) + 1e-9)
    angle = np.arctan2(along[1], along[0])
    turns = angle + np.linspace(np.pi / 2, 3 * np.pi / 2, 7)
    cap = np.column_stack([np.cos(turns), np.sin(turns)])
    return np.concatenate([start + width / 2 * cap, end - end_width / 2 * cap])


def _blob(rng: np.random.Generator, center: np.ndarray, size: float) -> Float[np.ndarray, "_ 2"]:
    turns = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    radii = size * rng.uniform(0.8, 1.2, 12)[:, None]
    return center + radii * np.column_stack([np.cos(turns), np.sin(turns)])


def _colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Wood, skin, steel, orange and blue gloves, or any other."""
    known = np.array(
        [[84, 122, 160], [130, 150, 200], [165, 168, 168], [30, 110, 230], [170, 110, 40]]
    )
    if rng.random() < 0.6:
        return known[rng.integers(len(known))] * rng.uniform(0.5, 1.2)
    return rng.uniform(10.0, 245.0, 3)
