"""Random skins: any colour, mottled, spotted, barred or striped; with eyes, gills and fin rays.

Textures of shape (S, Y, 3), BGR: rows from snout to tail, columns from back to belly. The ranges
were chosen by hand.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from stream_dmr.simulation.skin import noise

_ALONG, _ACROSS = 256, 96  # texture pixels from snout to tail, and from back to belly
ALONG_END = 1.03  # body lengths at the texture's last row: the tail's lobes reach past the fork
_BASE_COLOURS_BGR = np.array(  # browns, greys, olive, silver, gold, red, blue-grey, black, white
    [
        *([62, 82, 92], [90, 100, 105], [45, 75, 70], [190, 195, 190], [70, 140, 175]),
        *([75, 85, 170], [140, 120, 90], [30, 32, 35], [215, 220, 222]),
    ],
    np.float32,
)

# Of the sides, chosen by hand: of yellow and black reef fish the network took one colour only.
_TWO_COLOURS_SHARE = 0.08


def draw_skin_pair(
    rng: np.random.Generator, *, is_flatfish: bool
) -> Float32[np.ndarray, "2 S Y 3"]:
    """Both sides of one fish, BGR: alike for a round fish, dark and pale for most flatfish."""
    one = _draw_side(rng, is_countershaded=not is_flatfish)
    if not is_flatfish:
        return np.stack([one, one])
    other = _draw_blind_side(rng) if rng.random() < 0.7 else _draw_side(rng, is_countershaded=False)
    return np.stack([one, other])


def _draw_side(rng: np.random.Generator, *, is_countershaded: bool) -> Float32[np.ndarray, "S Y 3"]:
    """One side of a fish; a countershaded one is pale below."""
    s, y = _grid()
    colour = _BASE_COLOURS_BGR[rng.integers(len(_BASE_COLOURS_BGR))] * rng.uniform(0.6, 1.3)
    colour = colour * rng.uniform(0.8, 1.2, 3)
    side = np.broadcast_to(colour, (_ALONG, _ACROSS, 3)).astype(np.float32)
    if rng.random() < _TWO_COLOURS_SHARE:
        side = _draw_second_colour(rng, side, s, y)
    if is_countershaded and rng.random() < 0.85:
        belly = colour + rng.uniform(0.2, 1.0) * (np.array([215.0, 220.0, 220.0]) - colour)
        at, width = rng.uniform(-0.3, 0.7), rng.uniform(0.1, 0.6)
        wobble = 0.15 * _noise(rng, 14.0)
        pale = 1 / (1 + np.exp(-(y + wobble - at) / (0.25 * width)))
        side = side + pale[..., None] * (belly - side)
    tone = 1 + _draw_mottling(rng) + _draw_pattern(rng, s, y)
    tone = tone * _draw_marks(rng, s, y)
    side = np.ascontiguousarray(side * np.maximum(tone, 0.15)[..., None], np.float32)
    for eye_s, eye_y in _draw_eyes(rng, is_countershaded):
        _draw_eye(rng, side, eye_s, eye_y)
    return np.clip(side, 4, 255).astype(np.float32)


def _draw_second_colour(
    rng: np.random.Generator,
    side: Float32[np.ndarray, "S Y 3"],
    s: Float[np.ndarray, "S 1"],
    y: Float[np.ndarray, "1 Y"],
) -> Float32[np.ndarray, "S Y 3"]:
    """Another colour behind, before, above or below a slanting edge."""
    other = _BASE_COLOURS_BGR[rng.integers(len(_BASE_COLOURS_BGR))] * rng.uniform(0.5, 1.4, 3)
    slant, at = rng.normal(0.0, 0.25), rng.uniform(0.15, 0.85)
    along = (s - at) * rng.choice([-1.0, 1.0]) + slant * y + 0.02 * _noise(rng, 10.0)
    covered = 1 / (1 + np.exp(-along / rng.uniform(0.004, 0.03)))
    return (side + covered[..., None] * (other - side)).astype(np.float32)


def _draw_blind_side(rng: np.random.Generator) -> Float32[np.ndarray, "S Y 3"]:
    """The pale lower side of a flatfish, with red spots."""
    s, y = _grid()
    colour = np.array([205.0, 214.0, 218.0]) * rng.uniform(0.75, 1.1) * rng.uniform(0.93, 1.07, 3)
    tone = 1 + rng.uniform(0.2, 1.0) * _draw_mottling(rng)
    side = (tone * _draw_marks(rng, s, y))[..., None] * colour
    blood = rng.uniform(0.0, 1.0) * np.clip(_noise(rng, 9.0) - 1.0, 0.0, 1.0)[..., None]
    return np.clip(side * (1 - blood * np.array([0.3, 0.3, 0.05])), 8, 255).astype(np.float32)


def _draw_mottling(rng: np.random.Generator) -> Float[np.ndarray, "S Y"]:
    """Noise of three grain sizes, around 0."""
    sizes = rng.uniform(0.0, 1.0, 3) * [0.30, 0.22, 0.18]
    grains = (rng.uniform(9.0, 22.0), rng.uniform(3.0, 8.0), rng.uniform(0.8, 2.0))
    return sum(
        (size * _noise(rng, grain) for size, grain in zip(sizes, grains, strict=True)),
        np.zeros((_ALONG, _ACROSS)),
    )


def _draw_pattern(
    rng: np.random.Generator, s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"]
) -> Float[np.ndarray, "S Y"]:
    """Spots, bars across, stripes along, streaks, or nothing (one in three), around 0."""
    strength = rng.uniform(-0.6, 0.6)
    match int(rng.integers(6)):
        case 0:
            return strength * np.clip(_noise(rng, rng.uniform(2.0, 6.0)) - 1.0, 0.0, 1.0)
        case 1:
            waves = np.sin(2 * np.pi * rng.uniform(4, 14) * s + 0.6 * _noise(rng, 12.0))
            return 0.5 * strength * waves * np.ones_like(y)
        case 2:
            waves = np.sin(2 * np.pi * rng.uniform(1, 5) * y + 0.6 * _noise(rng, 14.0))
            return 0.5 * strength * waves * np.ones_like(s)
        case 3:
            grain = (rng.uniform(1.0, 3.0), rng.uniform(8.0, 20.0))
            grain = grain if rng.random() < 0.5 else (grain[1], grain[0])
            return 0.4 * strength * noise(rng, _ALONG, _ACROSS, grain_px=grain)
        case _:
            return np.zeros((_ALONG, _ACROSS))


def _draw_marks(
    rng: np.random.Generator, s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"]
) -> Float[np.ndarray, "S Y"]:
    """Gill cover, lateral line, pectoral fin, fringing fins, tail with its rays: as factors."""
    gill = np.exp(-(((s - rng.uniform(0.17, 0.27) + 0.05 * y**2) / 0.008) ** 2)) * (abs(y) < 0.8)
    arch = rng.uniform(0.0, 0.3) * np.exp(-(((s - 0.30) / 0.06) ** 2))
    line = np.exp(-(((y - arch - rng.uniform(-0.2, 0.1)) / 0.03) ** 2)) * ((s > 0.2) & (s < 0.9))
    pectoral_s, pectoral_y = rng.uniform(0.26, 0.36), rng.uniform(0.0, 0.5)
    pectoral = ((s - pectoral_s) / 0.06) ** 2 + (
        (y - pectoral_y - 1.5 * (s - pectoral_s)) / 0.12
    ) ** 2 < 1
    fringe = (abs(y) > rng.uniform(0.7, 0.9)) & (s > 0.2) & (s < 0.86)
    tail = s > rng.uniform(0.86, 0.93)
    rays = 0.1 * (np.sin(rng.uniform(25, 60) * y) > 0) * tail
    weights = rng.uniform(-0.15, 0.4, 5) * (rng.random(5) < 0.75)
    marks = zip(weights, (gill, line, pectoral, fringe, tail), strict=True)
    return 1 - sum((weight * mark for weight, mark in marks), rays)


def _draw_eyes(rng: np.random.Generator, is_round: bool) -> list[tuple[float, float]]:
    """Places (s, y) of the eyes on one side: one of a round fish, both of a flatfish."""
    if is_round:
        return [(rng.uniform(0.06, 0.12), rng.uniform(-0.6, -0.1))]
    first = rng.uniform(0.06, 0.1)
    return [
        (first, rng.uniform(0.1, 0.4)),
        (first + rng.uniform(0.0, 0.05), rng.uniform(-0.4, -0.1)),
    ]


def _draw_eye(
    rng: np.random.Generator, side: Float32[np.ndarray, "S Y 3"], s: float, y: float
) -> None:
    center = (round((y + 1) / 2 * (_ACROSS - 1)), round(s / ALONG_END * (_ALONG - 1)))
    size = rng.uniform(0.6, 1.4)
    # Wider across: the head is narrow, so the texture is compressed there.
    white, pupil = (round(8 * size), round(4 * size)), (round(5 * size), round(2.5 * size))
    iris = rng.uniform(30, 230, 3).tolist()
    cv2.ellipse(side, center, white, 0, 0, 360, iris, -1, cv2.LINE_AA)
    cv2.ellipse(side, center, pupil, 0, 0, 360, (12, 12, 14), -1, cv2.LINE_AA)


def _grid() -> tuple[Float32[np.ndarray, "S 1"], Float32[np.ndarray, "1 Y"]]:
    s = np.linspace(0.0, ALONG_END, _ALONG, dtype=np.float32)[:, None]
    y = np.linspace(-1.0, 1.0, _ACROSS, dtype=np.float32)[None]
    return s, y


def _noise(rng: np.random.Generator, grain: float) -> Float32[np.ndarray, "S Y"]:
    return noise(rng, _ALONG, _ACROSS, grain_px=(grain, grain))
