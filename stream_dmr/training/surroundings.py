"""Random backgrounds, and objects that hide fish. The ranges were chosen by hand.

Backgrounds are sea, murk, rock, deck, table, steel, clutter, or two of them. Objects are poles,
gloves, ropes, edges, lines: polygons in scene units (fish lengths, the fish at the origin), which
can be drawn into any crop.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.geometry import transformed
from stream_dmr.simulation.simulated_fish import noise

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
    # Brightness changes linearly across the picture.
    y, x = (np.mgrid[:BACKGROUND_PX, :BACKGROUND_PX] / BACKGROUND_PX - 0.5).astype(np.float32)
    slope = rng.normal(0.0, 0.35, 2)
    light = np.clip(1 + slope[0] * x + slope[1] * y, 0.3, 1.7).astype(np.float32)
    picture *= light[..., None]
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
    channels = [np.interp(heights, [0.0, 0.5, 0.85, 1.0], channel) for channel in stops.T]
    return np.stack(channels, axis=-1)


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
        if is_colourful:
            own = _any_colour(rng)
        else:
            own = main * rng.uniform(0.4, 1.5) * rng.uniform(0.8, 1.2, 3)
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
    picture = np.empty((BACKGROUND_PX, BACKGROUND_PX, 3), np.float32)
    picture[:] = _any_colour(rng)
    for _ in range(rng.integers(3, 16)):
        _draw_shape(rng, picture, _any_colour(rng))
    grain = rng.uniform(1.0, 8.0)
    texture = 1 + rng.uniform(0.0, 0.3) * _noise(rng, grain, grain * rng.uniform(0.4, 2.5))
    return picture * texture[..., None]


def _draw_shape(rng: np.random.Generator, picture: Picture, colour: np.ndarray) -> None:
    """An ellipse, a bar lit along its middle, or a polygon, drawn in place."""
    center = rng.integers(0, BACKGROUND_PX, 2)
    size = rng.uniform(6.0, 90.0)
    match int(rng.integers(4)):
        case 0:
            axes = (round(size), round(size * rng.uniform(0.2, 1.0)))
            arc = (center.tolist(), axes, float(rng.uniform(0, 180)), 0, 360)
            cv2.ellipse(picture, *arc, colour.tolist(), -1, cv2.LINE_AA)
        case 1:
            ends = center.tolist(), rng.integers(0, BACKGROUND_PX, 2).tolist()
            width = int(rng.integers(1, 22))
            cv2.line(picture, *ends, colour.tolist(), width, cv2.LINE_AA)
            cv2.line(picture, *ends, (colour * 1.4).tolist(), max(1, width // 3), cv2.LINE_AA)
        case _:
            angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 9)))
            points = np.round(center + size * _direction(angles)).astype(np.int32)
            cv2.fillPoly(picture, [points], colour.tolist(), cv2.LINE_AA)


def _draw_net(rng: np.random.Generator, picture: Picture) -> None:
    """A net of slanted meshes, drawn in place."""
    mesh, width = int(rng.integers(10, 50)), int(rng.integers(1, 4))
    slope = int(rng.integers(-BACKGROUND_PX, BACKGROUND_PX))
    colour = _any_colour(rng).tolist()
    for at in range(-BACKGROUND_PX, 2 * BACKGROUND_PX, mesh):
        cv2.line(picture, (at, 0), (at + slope, BACKGROUND_PX), colour, width, cv2.LINE_AA)
        cv2.line(picture, (0, at), (BACKGROUND_PX, at - slope), colour, width, cv2.LINE_AA)


def _half_plane(rng: np.random.Generator) -> Layer:
    """1 on one side of a random, slightly wavy edge, 0 on the other."""
    y, x = np.mgrid[:BACKGROUND_PX, :BACKGROUND_PX] - BACKGROUND_PX / 2
    angle = rng.choice([0.0, np.pi / 2, rng.uniform(0, 2 * np.pi)])
    distance_px = x * np.cos(angle) + y * np.sin(angle) - rng.uniform(-80.0, 80.0)
    distance_px = distance_px + rng.uniform(0.0, 6.0) * _noise(rng, 12.0, 12.0)
    return np.clip(distance_px / rng.uniform(1.0, 4.0) + 0.5, 0.0, 1.0).astype(np.float32)


def _water_colour(rng: np.random.Generator) -> np.ndarray:
    """BGR from blue to green to grey, of any brightness."""
    hue, saturation = rng.uniform(70.0, 125.0), rng.uniform(10.0, 220.0)
    return _from_hsv(hue, saturation, rng.uniform(50.0, 230.0))


def _any_colour(rng: np.random.Generator) -> np.ndarray:
    """BGR of any hue; low saturations are more frequent."""
    return _from_hsv(rng.uniform(0.0, 180.0), 255 * rng.beta(1.0, 1.8), rng.uniform(20.0, 240.0))


def _from_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    pixel = np.array([[[hue, saturation, value]]]).astype(np.uint8)
    return cv2.cvtColor(pixel, cv2.COLOR_HSV2BGR)[0, 0].astype(np.float64)


def _noise(rng: np.random.Generator, grain_x: float, grain_y: float) -> Layer:
    return noise(rng, BACKGROUND_PX, BACKGROUND_PX, grain_px=(grain_x, grain_y))


_WHITE, _YELLOW = [230, 232, 235], [40, 205, 235]  # BGR
# Wood, light and dark, white, grey and yellow plastic, and paint.
_BOARDS = [
    *([120, 175, 215], [60, 130, 205], [45, 60, 85], _WHITE),
    *([165, 168, 168], _YELLOW, [170, 110, 40]),
]
_SUBPIXEL_BITS = 4  # of OpenCV's `shift`: coordinates in sixteenths of a pixel


@dataclass(frozen=True, eq=False, kw_only=True)
class Occluder:
    """Opaque polygons in tones of one colour, later polygons over earlier ones."""

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
    end = start + 3.0 * _direction(angle)
    width = rng.uniform(0.004, 0.02)
    bars = [_bar(start, end, width, width)]
    if rng.random() < 0.5:
        bars += _hook(rng, start, angle, radius=rng.uniform(0.015, 0.04), width=0.012)
    shade = rng.uniform(20, 245) * rng.uniform(0.85, 1.15, 3)
    return Occluder(polygons=bars, tones=[1.0] * len(bars), colour=shade, hides=False)


def draw_ruler(rng: np.random.Generator, along_rad: float) -> Occluder:
    """A ruler or a measuring tape beside the fish, along it, with its marks."""
    along, width = _direction(along_rad + rng.normal(0.0, 0.06)), rng.uniform(0.02, 0.1)
    side = rng.choice([-1.0, 1.0])
    beside = side * (rng.uniform(0.08, 0.4) + width / 2) * _across(along)
    middle = beside + rng.normal(0.0, 0.2) * along
    yellow_or_white = _YELLOW if rng.random() < 0.5 else [225, 230, 230]
    colour = np.array(yellow_or_white) * rng.uniform(0.6, 1.05)
    return _scale(rng, middle, rng.uniform(0.4, 1.5) * along, width, colour)


def _scale(
    rng: np.random.Generator,
    middle: Float[np.ndarray, "2"],
    half: Float[np.ndarray, "2"],  # from the middle to one end
    width: float,
    colour: Float[np.ndarray, "3"],
) -> Occluder:
    """A strip with marks from one edge inwards, and perhaps dark spots for its numbers."""
    length = np.linalg.norm(half)
    along = half / length
    polygons, tones = [_strip(middle - half, middle + half, width)], [1.0]
    edge = middle + rng.choice([-0.5, 0.5]) * width * _across(along)
    side = np.sign((middle - edge) @ _across(along)) * width * _across(along)
    share, mark, pitch = rng.uniform(0.3, 0.9), rng.uniform(0.1, 0.6), rng.uniform(0.03, 0.1)
    has_numbers = rng.random() < 0.5
    for place in np.arange(-length + pitch, length, pitch):
        start = edge + place * along
        polygons.append(_strip(start, start + share * side, rng.uniform(0.1, 0.3) * pitch))
        if has_numbers:
            number = start + 0.35 * pitch * along + rng.uniform(0.3, 0.5) * side
            polygons.append(_strip(number, number + 0.35 * side, 0.25 * pitch))
    tones += [mark] * (len(polygons) - 1)
    return Occluder(polygons=polygons, tones=tones, colour=colour, hides=True)


def draw_board(rng: np.random.Generator, along_rad: float) -> list[Occluder]:
    """A measuring board or box beneath the fish, along it: floor and walls, scale, prints."""
    along = _direction(along_rad + rng.normal(0.0, 0.05))
    beside = _across(along)
    axes = np.stack([rng.uniform(0.48, 1.0) * along, rng.uniform(0.08, 0.4) * beside])
    middle = rng.normal(0.0, 0.08) * along + rng.normal(0.0, 0.03) * beside
    corners = middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ axes
    polygons, tones = [corners], [1.0]
    for seam in rng.uniform(-1.0, 1.0, rng.integers(1, 5) if rng.random() < 0.3 else 0):
        start = middle + seam * axes[1]
        polygons.append(_strip(start - axes[0], start + axes[0], rng.uniform(0.003, 0.015)))
        tones.append(rng.uniform(0.3, 0.8))
    share, thick, lit = rng.choice([0.0, 0.5, 1.0]), rng.uniform(0.015, 0.09), rng.uniform(0.6, 1.4)
    sides = [side for side in pairwise([*corners, corners[0]]) if rng.random() < share]
    for start, end in sides if rng.random() < 0.7 else []:  # what the walls shade
        polygons.append(_strip(start, end, thick * rng.uniform(1.3, 3.5)))
        tones.append(rng.uniform(0.35, 0.8))
    for start, end in sides:
        polygons.append(_strip(start, end, thick))
        tones.append(lit * rng.uniform(0.75, 1.3))
    colour = np.array(_BOARDS[rng.integers(len(_BOARDS))]) * rng.uniform(0.5, 1.1)
    if rng.random() < 0.3:
        colour = _any_colour(rng)
    parts = [Occluder(polygons=polygons, tones=tones, colour=colour, hides=True)]
    for _ in range(rng.integers(0, 4) if rng.random() < 0.5 else 0):
        half = rng.uniform(0.02, 0.08, 2)[:, None] * np.stack([along, beside])
        at = middle + rng.uniform(-0.9, 0.9, 2) @ axes
        print_ = _strip(at - half[0], at + half[0], 2 * float(np.linalg.norm(half[1])))
        parts.append(Occluder(polygons=[print_], tones=[1.0], colour=_any_colour(rng), hides=True))
    if rng.random() < 0.75:
        place = rng.uniform(-0.9, 0.9) if rng.random() < 0.6 else rng.normal(0.0, 0.2)
        strip = [_WHITE, _YELLOW, colour][rng.integers(3)]
        paint = np.clip(np.array(strip) * rng.uniform(0.7, 1.1), 0, 255)
        width = rng.uniform(0.03, 0.15)
        parts.append(_scale(rng, middle + place * axes[1], 0.97 * axes[0], width, paint))
    return parts


def draw_into(
    occluder: Occluder, crop_from_scene: Float[np.ndarray, "2 3"], *, size: int
) -> tuple[Float32[np.ndarray, "S S"], Float32[np.ndarray, "S S"]]:
    """The covered fraction of each crop pixel (0 to 1), and the tone there."""
    covered = np.zeros((size, size), np.float32)
    tones = np.ones((size, size), np.float32)
    for polygon, tone in zip(occluder.polygons, occluder.tones, strict=True):
        points = transformed(polygon, crop_from_scene)
        fixed = np.round(np.clip(points, -2000, 2000) * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        canvas = np.zeros((size, size), np.uint8)
        cv2.fillPoly(canvas, [fixed], 255, cv2.LINE_AA, _SUBPIXEL_BITS)
        part = canvas.astype(np.float32) / np.float32(255)
        covered = np.maximum(covered, part)
        tones += part * (np.float32(tone) - tones)
    return covered, tones


def with_thing(
    picture: Float32[np.ndarray, "S S 3"],
    thing: Occluder,
    crop_from_scene: Float[np.ndarray, "2 3"],
    *,
    texture: Float32[np.ndarray, "S S 1"] | float = 0.0,
) -> tuple[Float32[np.ndarray, "S S 3"], Float32[np.ndarray, "S S"]]:
    """A crop (BGR) with a thing before it, and the fraction of each pixel that this covers.

    `texture`: by how much of its light each pixel of the thing is lighter.
    """
    covered, tones = draw_into(thing, crop_from_scene, size=len(picture))
    tone = tones[..., None] * (1 + texture)
    return picture + covered[..., None] * (tone * np.float32(thing.colour) - picture), covered


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
    around = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    polygons.append(palm + size * rng.uniform(0.8, 1.2, 12)[:, None] * _direction(around))
    for spread in np.linspace(-0.9, 0.9, rng.integers(3, 6)):
        bend = angle + np.pi + spread + rng.normal(0.0, 0.1)
        tip = palm + rng.uniform(1.2, 2.4) * size * _direction(bend)
        polygons.append(_bar(palm, tip, 0.55 * size, 0.4 * size))
    tones = rng.uniform(0.8, 1.2, len(polygons)).tolist()
    return Occluder(polygons=polygons, tones=tones, colour=_colour(rng), hides=True)


def _draw_rope(rng: np.random.Generator) -> Occluder:
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
    arc = radius * _direction(turns)
    arc = arc - arc[0] + at
    return [_bar(a, b, width, width) for a, b in pairwise(arc)]


def _direction(angle: float | Float[np.ndarray, "N"]) -> Float[np.ndarray, "*N 2"]:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _bar(
    start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], width: float, end_width: float
) -> Float[np.ndarray, "_ 2"]:
    """A bar with half-round ends."""
    along = (end - start) / (np.linalg.norm(end - start) + 1e-9)
    angle = np.arctan2(along[1], along[0])
    turns = angle + np.linspace(np.pi / 2, 3 * np.pi / 2, 7)
    cap = _direction(turns)
    return np.concatenate([start + width / 2 * cap, end - end_width / 2 * cap])


def _across(along: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    return along[::-1] * [-1.0, 1.0]


def _strip(
    start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"], width: float
) -> Float[np.ndarray, "4 2"]:
    """A bar with square ends."""
    along = (end - start) / (np.linalg.norm(end - start) + 1e-9)
    beside = width / 2 * _across(along)
    return np.array([start + beside, end + beside, end - beside, start - beside])


def _colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """BGR of wood, skin, steel, orange and blue gloves, or any other."""
    known = [[84, 122, 160], [130, 150, 200], [165, 168, 168], [30, 110, 230], [170, 110, 40]]
    if rng.random() < 0.6:
        return np.array(known[rng.integers(len(known))]) * rng.uniform(0.5, 1.2)
    return rng.uniform(10.0, 245.0, 3)
