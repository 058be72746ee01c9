"""Random objects between the camera and a fish: poles, gloves, ropes, edges, lines.

Each is a set of polygons in scene units (fish lengths, the fish at the origin), so that it can be
drawn into any crop. The ranges were chosen by hand.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, Float32

_SUBPIXEL_BITS = 4  # of OpenCV's `shift`: coordinates in sixteenths of a pixel


@dataclass(frozen=True, eq=False, kw_only=True)
class Occluder:
    """Opaque polygons in tones of one colour, later ones over earlier ones."""

    polygons: list[Float[np.ndarray, "_ 2"]]  # scene units
    tones: list[float]  # factor of the colour, per polygon
    colour: Float[np.ndarray, "3"]  # BGR
    hides: bool  # its pixels are not fish; False for lines, too thin to matter


def draw_occluders(rng: np.random.Generator) -> list[Occluder]:
    """No occluder in 59 % of all scenes, else mostly one."""
    chances = {_draw_pole: 0.26, _draw_glove: 0.10, _draw_rope: 0.06, _draw_edge: 0.05}
    return [draw(rng) for draw, chance in chances.items() if rng.random() < chance]


def draw_line(rng: np.random.Generator, start: Float[np.ndarray, "2"]) -> Occluder:
    """A fishing line from a point upwards, out of the picture; half of them with a hook."""
    angle = np.radians(rng.normal(-90.0, 12.0))
    end = start + 3.0 * np.array([np.cos(angle), np.sin(angle)])
    width = rng.uniform(0.004, 0.02)
    bars = [_bar(start, end, width, width)]
    if rng.random() < 0.5:
        bars += _hook(rng, start, angle, radius=rng.uniform(0.015, 0.04), width=0.012)
    shade = rng.uniform(20, 245) * rng.uniform(0.85, 1.15, 3)
    return Occluder(polygons=bars, tones=[1.0] * len(bars), colour=shade, hides=False)


def draw_ruler(rng: np.random.Generator, along_rad: float) -> Occluder:
    """A ruler or a measuring tape beside the fish, along it, with its marks."""
    along, width = _direction(along_rad + rng.normal(0.0, 0.06)), rng.uniform(0.02, 0.1)
    beside = along[::-1] * [-1.0, 1.0]  # at a right angle
    side = rng.choice([-1.0, 1.0])
    middle = side * (rng.uniform(0.08, 0.4) + width / 2) * beside + rng.normal(0.0, 0.2) * along
    half = rng.uniform(0.4, 1.5)
    polygons, tones = [_strip(middle - half * along, middle + half * along, width)], [1.0]
    edge = middle + rng.choice([-0.5, 0.5]) * width * beside
    inwards = np.sign((middle - edge) @ beside) * rng.uniform(0.3, 0.9) * width * beside
    mark, pitch = rng.uniform(0.1, 0.6), rng.uniform(0.03, 0.1)
    for place in np.arange(-half + pitch, half, pitch):
        start = edge + place * along
        polygons.append(_strip(start, start + inwards, rng.uniform(0.1, 0.3) * pitch))
        tones.append(mark)
    yellow_or_white = [40, 205, 235] if rng.random() < 0.5 else [225, 230, 230]
    colour = np.array(yellow_or_white) * rng.uniform(0.6, 1.05)
    return Occluder(polygons=polygons, tones=tones, colour=colour, hides=True)


def draw_into(
    occluder: Occluder, crop_from_scene: Float[np.ndarray, "2 3"], *, size: int
) -> tuple[Float32[np.ndarray, "S S"], Float32[np.ndarray, "S S"]]:
    """The covered fraction of each crop pixel (0 to 1), and the tone there."""
    covered = np.zeros((size, size), np.float32)
    tones = np.ones((size, size), np.float32)
    for polygon, tone in zip(occluder.polygons, occluder.tones, strict=True):
        points = polygon @ crop_from_scene[:, :2].T + crop_from_scene[:, 2]
        fixed = np.round(np.clip(points, -2000, 2000) * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        canvas = np.zeros((size, size), np.uint8)
        cv2.fillPoly(canvas, [fixed], 255, cv2.LINE_AA, _SUBPIXEL_BITS)
        part = canvas.astype(np.float32) / np.float32(255)
        covered = np.maximum(covered, part)
        tones += part * (np.float32(tone) - tones)
    return covered, tones


def _draw_pole(rng: np.random.Generator) -> Occluder:
    """A gaff: a pole, lit along its middle, with its tip on or near the fish."""
    tip = rng.normal(0.0, 0.2, 2)
    angle = rng.uniform(0.0, 2 * np.pi)
    width = rng.uniform(0.02, 0.09)
    bars, tones = _lit_bar(rng, tip, tip + 3.0 * _direction(angle), width)
    if rng.random() < 0.7:
        hook = _hook(rng, tip, angle, radius=rng.uniform(0.04, 0.09), width=0.3 * width)
        bars, tones = bars + hook, tones + [rng.uniform(0.7, 1.6)] * len(hook)
    return Occluder(polygons=bars, tones=tones, colour=_colour(rng), hides=True)


def _draw_glove(rng: np.random.Generator) -> Occluder:
    """A gloved hand on the fish: an arm, a palm, three to five fingers."""
    palm = rng.normal(0.0, 0.28, 2)
    angle = rng.uniform(0.0, 2 * np.pi)
    size = rng.uniform(0.06, 0.16)
    polygons = [_bar(palm, palm + 3.0 * _direction(angle), 1.5 * size, 2.2 * size)]
    polygons.append(_blob(rng, palm, size))
    for spread in np.linspace(-0.9, 0.9, rng.integers(3, 6)):
        bend = angle + np.pi + spread + rng.normal(0.0, 0.1)
        tip = palm + rng.uniform(1.2, 2.4) * size * _direction(bend)
        polygons.append(_bar(palm, tip, 0.55 * size, 0.4 * size))
    tones = rng.uniform(0.8, 1.2, len(polygons)).tolist()
    return Occluder(polygons=polygons, tones=tones, colour=_colour(rng), hides=True)


def _draw_rope(rng: np.random.Generator) -> Occluder:
    """A rope straight across the picture."""
    """A rope straight across the picture."""
    center, half = rng.normal(0.0, 0.3, 2), 3.0 * _direction(rng.uniform(0.0, np.pi))
    bars, tones = _lit_bar(rng, center - half, center + half, rng.uniform(0.03, 0.08))
    return Occluder(polygons=bars, tones=tones, colour=_colour(rng), hides=True)


def _draw_edge(rng: np.random.Generator) -> Occluder:
    """A rail, a crate or a shoulder that covers one side."""
    outwards = _direction(rng.uniform(0.0, 2 * np.pi))
    near = outwards * rng.uniform(0.05, 0.5)
    wall = _bar(near, near + 3.0 * outwards, 5.0, 5.0)
    return Occluder(polygons=[wall], tones=[1.0], colour=_colour(rng), hides=True)


def _lit_bar(
    rng: np.random.Generator,
    start: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    width: float,
) -> tuple[list[Float[np.ndarray, "_ 2"]], list[float]]:
    """A round bar: darker at its sides, with a highlight; 25 % are flat."""
    shares = [1.0, rng.uniform(0.45, 0.8), rng.uniform(0.1, 0.3)]
    tones = np.cumprod([rng.uniform(0.5, 1.0), rng.uniform(1.1, 1.9), rng.uniform(1.0, 1.5)])
    if rng.random() < 0.25:
        tones[:] = 1.0
    return [_bar(start, end, share * width, share * width) for share in shares], tones.tolist()


def _hook(
    rng: np.random.Generator,
    at: Float[np.ndarray, "2"],
    angle: float,
    *,
    radius: float,
    width: float,
) -> list[Float[np.ndarray, "_ 2"]]:
    """A bent wire that begins at `at`, opposite to a bar that leaves at `angle`."""
    turns = angle + np.pi + np.linspace(-0.4, 2.6, 9) * rng.choice([-1.0, 1.0])
    arc = radius * np.column_stack([np.cos(turns), np.sin(turns)])
    arc = arc - arc[0] + at
    return [_bar(a, b, width, width) for a, b in pairwise(arc)]


def _direction(angle: float) -> Float[np.ndarray, "2"]:
    return np.array([np.cos(angle), np.sin(angle)])


def _bar(
    start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], width: float, end_width: float
) -> Float[np.ndarray, "_ 2"]:
    """A bar with half-round ends."""
    along = (end - start) / (np.linalg.norm(end - start) + 1e-9)
    angle = np.arctan2(along[1], along[0])
    turns = angle + np.linspace(np.pi / 2, 3 * np.pi / 2, 7)
    cap = np.column_stack([np.cos(turns), np.sin(turns)])
    return np.concatenate([start + width / 2 * cap, end - end_width / 2 * cap])


def _strip(
    start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], width: float
) -> Float[np.ndarray, "4 2"]:
    """A bar with square ends."""
    along = (end - start) / (np.linalg.norm(end - start) + 1e-9)
    beside = width / 2 * along[::-1] * [-1.0, 1.0]
    return np.array([start + beside, end + beside, end - beside, start - beside])


def _blob(rng: np.random.Generator, center: np.ndarray, size: float) -> Float[np.ndarray, "_ 2"]:
    turns = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    radii = size * rng.uniform(0.8, 1.2, 12)[:, None]
    return center + radii * np.column_stack([np.cos(turns), np.sin(turns)])


def _colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """BGR of wood, skin, steel, orange and blue gloves, or any other."""
    known = np.array(
        [[84, 122, 160], [130, 150, 200], [165, 168, 168], [30, 110, 230], [170, 110, 40]]
    )
    if rng.random() < 0.6:
        return known[rng.integers(len(known))] * rng.uniform(0.5, 1.2)
    return rng.uniform(10.0, 245.0, 3)
