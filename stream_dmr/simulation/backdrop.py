"""The background and the gear: sea, the vessel's side with its roller, lines, hooks, a gaff."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from stream_dmr.simulation.skin import noise

# The numbers of this file were chosen by eye.
_RAIL_PX = 58
_SEA_MARGIN_PX = 240  # amplitude of the drift of the layers of the sea
_GAFF_PX = 13
_SUBPIXEL = 4  # fractional bits, OpenCV's `shift`

# Colour map of the waves: grey level -> BGR, from troughs over green slopes to foam.
_SEA_STOPS = [0, 70, 130, 185, 212, 235, 255]
_SEA_BGR = [
    (38, 30, 18),
    (66, 56, 34),
    (98, 88, 60),
    (140, 130, 100),
    (176, 170, 146),
    (218, 216, 205),
    (240, 240, 236),
]


class Backdrop:
    """Sea and vessel of one scene; `draw(frame_index)` returns a new picture of them."""

    def __init__(self, rng: np.random.Generator, *, width: int, height: int) -> None:
        self._width, self._height = width, height
        big = (height + _SEA_MARGIN_PX, width + _SEA_MARGIN_PX)
        self._swell = _grey(
            0.8 * noise(rng, *big, grain_px=(90.0, 34.0)) + _ripples(rng, big, 11.0)
        )
        self._chop = _grey(_ripples(rng, big, 5.0) + 0.5 * _ripples(rng, big, 2.2))
        self._colours = np.stack(
            [
                np.interp(np.arange(256), _SEA_STOPS, channel)
                for channel in zip(*_SEA_BGR, strict=True)
            ],
            axis=-1,
        ).astype(np.uint8)[:, None]
        self._rail, self._rail_mask = _draw_rail(rng, width)
        self._drift = rng.uniform(0.0, 2 * np.pi, 2)
        self.roller_px = np.array([width * rng.uniform(0.35, 0.65), _RAIL_PX - 14.0])
        _draw_roller(self._rail, self._rail_mask, self.roller_px)

    def draw(self, frame_index: int) -> UInt8[np.ndarray, "H W 3"]:
        """The sea at this frame, and the vessel in front of it, BGR."""
        swell = self._cut(self._swell, speed=0.021, frame_index=frame_index, phase=self._drift[0])
        chop = self._cut(self._chop, speed=-0.033, frame_index=frame_index, phase=self._drift[1])
        waves = cv2.addWeighted(swell, 0.62, chop, 0.38, 0.0)
        image = cv2.applyColorMap(waves, self._colours)
        top = image[: len(self._rail)]
        top[self._rail_mask] = self._rail[self._rail_mask]
        return image

    def _cut(
        self, layer: UInt8[np.ndarray, "A B"], *, speed: float, frame_index: int, phase: float
    ) -> UInt8[np.ndarray, "H W"]:
        turn = speed * frame_index + phase
        x, y = (np.array([np.cos(turn), np.sin(turn)]) + 1) / 2 * (_SEA_MARGIN_PX - 1)
        return layer[int(y) : int(y) + self._height, int(x) : int(x) + self._width]


def draw_line(
    image: UInt8[np.ndarray, "H W 3"],
    *,
    mouth_px: Float[np.ndarray, "2"],
    roller_px: Float[np.ndarray, "2"],
) -> None:
    """Draw the gangion from the fish's mouth up towards the roller, out of the picture."""
    top = np.array([(mouth_px[0] + roller_px[0]) / 2, -40.0])
    line = (_fixed(mouth_px), _fixed(top))
    cv2.line(image, *line, (52, 60, 62), 4, cv2.LINE_AA, _SUBPIXEL)
    cv2.line(image, *line, (186, 200, 200), 2, cv2.LINE_AA, _SUBPIXEL)


def draw_hook(image: UInt8[np.ndarray, "H W 3"], *, mouth_px: Float[np.ndarray, "2"]) -> None:
    """Draw the shank and bend of a circle hook in the fish's mouth, over the fish."""
    center = _fixed(mouth_px - np.array([2.5, 1.0]))
    axes = (4 << _SUBPIXEL, 5 << _SUBPIXEL)
    cv2.ellipse(image, center, axes, 0, -40, 200, (150, 156, 158), 2, cv2.LINE_AA, _SUBPIXEL)


def draw_gaff(
    image: UInt8[np.ndarray, "H W 3"],
    *,
    hand_px: Float[np.ndarray, "2"],
    tip_px: Float[np.ndarray, "2"],
) -> Bool[np.ndarray, "H W"]:
    """Draw a pole with a steel hook from hand to tip; return the pixels that it covers."""
    hand, tip = _fixed(hand_px), _fixed(tip_px)
    colours = ((44, 72, 104), _GAFF_PX), ((84, 122, 160), _GAFF_PX - 5), ((130, 165, 196), 2)
    for colour, thickness in colours:
        cv2.line(image, hand, tip, colour, thickness, cv2.LINE_AA, _SUBPIXEL)
    along = (tip_px - hand_px) / (np.linalg.norm(tip_px - hand_px) + 1e-9)
    bend = _fixed(tip_px + 12 * np.array([-along[1], along[0]]))
    angle = float(np.degrees(np.arctan2(along[1], along[0])))
    axes = (12 << _SUBPIXEL, 12 << _SUBPIXEL)
    covered = np.zeros(image.shape[:2], np.uint8)
    cv2.ellipse(image, bend, axes, angle, -90, 110, (165, 168, 168), 5, cv2.LINE_AA, _SUBPIXEL)
    cv2.ellipse(covered, bend, axes, angle, -90, 110, 1, 5, cv2.LINE_8, _SUBPIXEL)
    cv2.line(covered, hand, tip, 1, _GAFF_PX, cv2.LINE_8, _SUBPIXEL)
    return covered.astype(bool)


def _fixed(pixel: Float[np.ndarray, "2"]) -> tuple[int, int]:
    """A pixel in OpenCV's fixed-point numbers, with `_SUBPIXEL` fractional bits."""
    x, y = np.round(pixel * (1 << _SUBPIXEL)).astype(int).tolist()
    return x, y


def _ripples(
    rng: np.random.Generator, size: tuple[int, int], grain: float
) -> Float32[np.ndarray, "A B"]:
    """Waves with crests: ridged noise, 2.6 times longer along x than along y."""
    ridged = 1 - np.abs(noise(rng, *size, grain_px=(2.6 * grain, grain)))
    return ridged.astype(np.float32)


def _grey(waves: Float32[np.ndarray, "A B"]) -> UInt8[np.ndarray, "A B"]:
    scaled = 110 + 48 * (waves - waves.mean()) / waves.std()
    return np.clip(scaled, 0, 255).astype(np.uint8)


def _draw_rail(
    rng: np.random.Generator, width: int
) -> tuple[UInt8[np.ndarray, "R W 3"], Bool[np.ndarray, "R W"]]:
    """Picture and mask of the vessel's side: painted steel with streaks of rust and a worn edge."""
    height = _RAIL_PX + 24
    slope = rng.uniform(-14.0, 14.0)
    edge = _RAIL_PX + slope * np.linspace(-1.0, 1.0, width)
    y = np.arange(height)[:, None]
    paint = 128 + 5 * noise(rng, height, width, grain_px=(30.0, 8.0))
    paint += 3 * noise(rng, height, width, grain_px=(1.0, 1.0))
    steel = paint[..., None] * np.array([0.92, 0.98, 0.96], np.float32)
    rust = np.clip(noise(rng, height, width, grain_px=(3.0, 26.0)) - 1.1, 0.0, 1.0)[..., None]
    steel = steel * (1 - rust) + rust * np.array([38, 66, 112], np.float32)
    lip = np.exp(-(((y - edge + 6) / 4.0) ** 2))[..., None]
    steel = steel * (1 - 0.55 * lip) + 0.55 * lip * 190
    steel *= (0.6 + 0.4 * np.clip((edge - y) / 4.0, 0.0, 1.0))[..., None]  # its shadowed underside
    return np.clip(steel, 0, 255).astype(np.uint8), y < edge


def _draw_roller(
    rail: UInt8[np.ndarray, "R W 3"], mask: Bool[np.ndarray, "R W"], center: Float[np.ndarray, "2"]
) -> None:
    """Draw the drum that the groundline runs over into `rail`, and add it to `mask`."""
    x, y = np.round(center).astype(int).tolist()
    covered = mask.astype(np.uint8)
    for half, colour in ((30, (40, 42, 44)), (24, (92, 96, 98)), (10, (150, 154, 156))):
        box = (x - 3 * half // 2, y - half // 2), (x + 3 * half // 2, y + half // 2)
        cv2.rectangle(rail, *box, colour, -1, cv2.LINE_AA)
        cv2.rectangle(covered, *box, 1, -1)
    mask |= covered.astype(bool)
