"""Random backgrounds: sea, murk, rock, deck, table, steel, clutter, or two of them.

The ranges were chosen by hand.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stream_dmr.simulation.skin import noise

BACKGROUND_PX = 256  # width and height; so that each crop of 128 px is another piece

Picture = Float[np.ndarray, "B B 3"]
Layer = Float[np.ndarray, "B B"]


def draw_background(rng: np.random.Generator) -> UInt8[np.ndarray, "B B 3"]:
    """One picture, BGR; in 20 % two kinds meet at an edge."""
    picture = _draw_one(rng)
    if rng.random() < 0.2:
        other, share = _draw_one(rng), _half_plane(rng)[..., None]
        picture = picture + share * (other - picture)
    if rng.random() < 0.15:
        _draw_net(rng, picture)
    picture *= _draw_illumination(rng)[..., None]
    return np.clip(picture, 0, 255).astype(np.uint8)


def _draw_one(rng: np.random.Generator) -> Picture:
    kinds: list[Callable[[np.random.Generator], Picture]] = [
        *(_draw_sea, _draw_sea, _draw_murk, _draw_murk, _draw_rock, _draw_rock),
        *(_draw_deck, _draw_table, _draw_steel, _draw_clutter, _draw_clutter),
    ]
    return kinds[rng.integers(len(kinds))](rng).astype(np.float32)


def _draw_sea(rng: np.random.Generator) -> Picture:
    """Waves coloured by their height, with foam on the crests."""
    grain = rng.uniform(2.0, 14.0)
    stretch = rng.uniform(1.2, 3.5)
    ridged = 1 - np.abs(_noise(rng, stretch * grain, grain))
    finer = 1 - np.abs(_noise(rng, 0.4 * stretch * grain, 0.4 * grain))
    swell = _noise(rng, rng.uniform(30.0, 60.0), rng.uniform(15.0, 40.0))
    waves = ridged + rng.uniform(0.2, 0.7) * finer + rng.uniform(0.0, 1.0) * swell
    dark = _water_colour(rng) * 0.4
    stops = np.stack([dark, dark * 1.8 + 10, dark * 2.6 + 40, [225.0, 225.0, 220.0]])
    foam_from = rng.uniform(0.75, 1.3)
    heights = np.clip((waves - waves.min()) / np.ptp(waves) / foam_from, 0, 1)
    return _colour_map(heights, stops, [0.0, 0.5, 0.85, 1.0])


def _draw_murk(rng: np.random.Generator) -> Picture:
    """Clouds of three colours, as of sea out of focus or of turbid water."""
    colours = [_water_colour(rng) * rng.uniform(0.3, 1.3) for _ in range(3)]
    picture = np.zeros((BACKGROUND_PX, BACKGROUND_PX, 3)) + colours[0]
    for colour in colours[1:]:
        cloud = _noise(rng, rng.uniform(15.0, 70.0), rng.uniform(15.0, 70.0))
        picture += (1 / (1 + np.exp(-1.5 * cloud)))[..., None] * (colour - picture)
    if rng.random() < 0.6:
        picture *= 1 + rng.uniform(0.02, 0.15) * _noise(rng, 6.0, 6.0)[..., None]
    return picture


def _draw_rock(rng: np.random.Generator) -> Picture:
    """Layers with hard, lit edges: rock, weed, wood, coral."""
    main = _any_colour(rng)
    is_colourful = rng.random() < 0.35
    picture = main * rng.uniform(0.2, 0.8) + np.zeros((BACKGROUND_PX, BACKGROUND_PX, 1))
    for _ in range(rng.integers(2, 7)):
        grain = rng.uniform(4.0, 30.0)
        height = _noise(rng, grain * rng.uniform(0.5, 2.0), grain)
        height = height + 0.4 * _noise(rng, 0.3 * grain, 0.3 * grain)
        mask = (height > rng.uniform(-0.3, 1.0)).astype(np.float32)
        relief = cv2.Sobel(height, cv2.CV_32F, *((1, 0) if rng.random() < 0.5 else (0, 1)))
        tone = 1 + rng.uniform(0.0, 0.5) * relief / (relief.std() + 1e-6)
        tone = tone + rng.uniform(0.0, 0.3) * _noise(rng, 1.5, 1.5)
        own = (
            _any_colour(rng)
            if is_colourful
            else main * rng.uniform(0.4, 1.5) * rng.uniform(0.8, 1.2, 3)
        )
        colour = own * np.clip(tone, 0.2, 2.5)[..., None]
        picture += cv2.GaussianBlur(mask, (0, 0), 0.7)[..., None] * (colour - picture)
    return picture


def _draw_deck(rng: np.random.Generator) -> Picture:
    """Planks, slats or a belt's ribs, with seams and stains."""
    angle, period = rng.uniform(0, np.pi), rng.uniform(10.0, 70.0)
    y, x = np.mgrid[:BACKGROUND_PX, :BACKGROUND_PX]
    across = (x * np.cos(angle) + y * np.sin(angle)) / period
    planks = rng.uniform(0.75, 1.25, 64)[np.floor(across).astype(int) % 64]
    seam = np.exp(-(((across % 1 - 0.5) / rng.uniform(0.02, 0.15)) ** 2))
    tone = planks * (1 - rng.uniform(-0.5, 0.8) * seam) + 0.08 * _noise(rng, 1.0, 1.0)
    stain = 1 + rng.uniform(0.0, 0.3) * _noise(rng, 20.0, 20.0)
    return (np.clip(tone * stain, 0.1, 3.0)[..., None] * _any_colour(rng)).astype(np.float32)


def _draw_table(rng: np.random.Generator) -> Picture:
    """A plain board or tray, perhaps with a ruler of dark and light squares, or a grid."""
    tone = 1 + rng.uniform(0.0, 0.06) * _noise(rng, 1.0, 1.0)
    tone = tone + rng.uniform(0.0, 0.1) * _noise(rng, 40.0, 40.0)
    picture = (tone[..., None] * _any_colour(rng)).astype(np.float32)
    for _ in range(rng.integers(0, 3)):
        top, size = int(rng.integers(BACKGROUND_PX)), int(rng.integers(5, 26))
        light, dark = _any_colour(rng) + 40, _any_colour(rng) * 0.3
        columns = np.arange(BACKGROUND_PX) // size % 2
        row = np.where(columns[:, None] == 0, light, dark)
        picture[top : top + int(size * rng.uniform(0.5, 2.0))] = row
    if rng.random() < 0.3:
        picture = np.ascontiguousarray(picture.transpose(1, 0, 2))
    return picture


def _draw_steel(rng: np.random.Generator) -> Picture:
    """Painted metal with rust, a lit edge and bolts."""
    paint = _any_colour(rng) * (1 + 0.08 * _noise(rng, 30.0, 8.0))[..., None]
    rust = np.clip(_noise(rng, rng.uniform(2, 8), rng.uniform(8, 40)) - rng.uniform(0.6, 1.6), 0, 1)
    picture = paint + rust[..., None] * (np.array([38.0, 66.0, 112.0]) - paint)
    picture = np.ascontiguousarray(picture, np.float32)
    for _ in range(rng.integers(0, 4)):
        _draw_shape(rng, picture, _any_colour(rng))
    return picture


def _draw_clutter(rng: np.random.Generator) -> Picture:
    """Shapes upon shapes, each with a texture of its own."""
    picture = np.ascontiguousarray(
        _any_colour(rng) + np.zeros((BACKGROUND_PX, BACKGROUND_PX, 3)), np.float32
    )
    for _ in range(rng.integers(3, 16)):
        _draw_shape(rng, picture, _any_colour(rng))
    grain = rng.uniform(1.0, 8.0)
    texture = 1 + rng.uniform(0.0, 0.3) * _noise(rng, grain, grain * rng.uniform(0.4, 2.5))
    return picture * texture[..., None]


def _draw_shape(rng: np.random.Generator, picture: Picture, colour: np.ndarray) -> None:
    """An ellipse, a bar lit along its middle, or a polygon, drawn in place."""
    """An ellipse, a bar lit along its middle, or a polygon, drawn in place."""
    center = rng.integers(0, BACKGROUND_PX, 2)
    size = rng.uniform(6.0, 90.0)
    match int(rng.integers(4)):
        case 0:
            axes = (round(size), round(size * rng.uniform(0.2, 1.0)))
            angle_deg = float(rng.uniform(0, 180))
            cv2.ellipse(
                picture, center.tolist(), axes, angle_deg, 0, 360, colour.tolist(), -1, cv2.LINE_AA
            )
        case 1:
            other = rng.integers(0, BACKGROUND_PX, 2)
            width = int(rng.integers(1, 22))
            cv2.line(picture, center.tolist(), other.tolist(), colour.tolist(), width, cv2.LINE_AA)
            lit = (colour * 1.4).tolist()
            cv2.line(picture, center.tolist(), other.tolist(), lit, max(1, width // 3), cv2.LINE_AA)
        case _:
            angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 9)))
            corners = center + size * np.column_stack([np.cos(angles), np.sin(angles)])
            points = np.round(corners).astype(np.int32)
            cv2.fillPoly(picture, [points], colour.tolist(), cv2.LINE_AA)


def _draw_net(rng: np.random.Generator, picture: Picture) -> None:
    """A net of slanted meshes, drawn in place."""
    """A net of slanted meshes, drawn in place."""
    mesh, width = int(rng.integers(10, 50)), int(rng.integers(1, 4))
    slope = int(rng.integers(-BACKGROUND_PX, BACKGROUND_PX))
    colour = _any_colour(rng).tolist()
    for at in range(-BACKGROUND_PX, 2 * BACKGROUND_PX, mesh):
        cv2.line(picture, (at, 0), (at + slope, BACKGROUND_PX), colour, width, cv2.LINE_AA)
        cv2.line(picture, (0, at), (BACKGROUND_PX, at - slope), colour, width, cv2.LINE_AA)


def _half_plane(rng: np.random.Generator) -> Layer:
    """1 on one side of a random, slightly wavy edge, 0 on the other."""
    """1 on one side of a random, slightly wavy edge, 0 on the other."""
    y, x = np.mgrid[:BACKGROUND_PX, :BACKGROUND_PX] - BACKGROUND_PX / 2
    angle = rng.choice([0.0, np.pi / 2, rng.uniform(0, 2 * np.pi)])
    distance_px = x * np.cos(angle) + y * np.sin(angle) - rng.uniform(-80.0, 80.0)
    distance_px = distance_px + rng.uniform(0.0, 6.0) * _noise(rng, 12.0, 12.0)
    return np.clip(distance_px / rng.uniform(1.0, 4.0) + 0.5, 0.0, 1.0).astype(np.float32)


def _draw_illumination(rng: np.random.Generator) -> Layer:
    """Brightness factors that change linearly across the picture."""
    """Brightness factors that change linearly across the picture."""
    y, x = (np.mgrid[:BACKGROUND_PX, :BACKGROUND_PX] / BACKGROUND_PX - 0.5).astype(np.float32)
    slope = rng.normal(0.0, 0.35, 2)
    return np.clip(1 + slope[0] * x + slope[1] * y, 0.3, 1.7).astype(np.float32)


def _water_colour(rng: np.random.Generator) -> np.ndarray:
    """BGR from blue to green to grey, of any brightness."""
    hue, saturation = rng.uniform(70.0, 125.0), rng.uniform(10.0, 220.0)
    return _from_hsv(hue, saturation, rng.uniform(50.0, 230.0))


def _any_colour(rng: np.random.Generator) -> np.ndarray:
    """BGR of any hue; low saturations are more frequent."""
    """BGR of any hue; low saturations are more frequent."""
    return _from_hsv(rng.uniform(0.0, 180.0), 255 * rng.beta(1.0, 1.8), rng.uniform(20.0, 240.0))


def _from_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    pixel = np.array([[[hue, saturation, value]]]).astype(np.uint8)
    return cv2.cvtColor(pixel, cv2.COLOR_HSV2BGR)[0, 0].astype(np.float64)


def _colour_map(heights: Layer, colours: np.ndarray, stops: list[float]) -> Picture:
    return np.stack([np.interp(heights, stops, channel) for channel in colours.T], axis=-1)


def _noise(rng: np.random.Generator, grain_x: float, grain_y: float) -> Layer:
    return noise(rng, BACKGROUND_PX, BACKGROUND_PX, grain_px=(grain_x, grain_y))
