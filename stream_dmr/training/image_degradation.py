"""Random changes of a picture, and the fish and backgrounds that pictures are composed of.

Weather, optics and sensor move no outline; their ranges were chosen by hand. Simulated fish and
backgrounds are cached in a file, and used beside photographed fish and backgrounds.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from stream_dmr.files import replacing
from stream_dmr.simulation.simulated_fish import line_kernel
from stream_dmr.training.random_fish import PATCH_PX, FishPatch, draw_fish_patch
from stream_dmr.training.surroundings import BACKGROUND_PX, draw_background

Picture = Float32[np.ndarray, "S S 3"]  # BGR, 0 to 255


def add_weather(rng: np.random.Generator, picture: Picture) -> Picture:
    """Shadow, haze, glare, spray and drops, each in some pictures; 40 % have none."""
    size = len(picture)
    if rng.random() < 0.4:
        return picture
    if rng.random() < 0.35:
        shadow = _cloud(rng, size, rng.uniform(10.0, 50.0)) * rng.uniform(0.1, 0.6)
        picture = picture * (1 - shadow[..., None])
    if rng.random() < 0.25:
        haze, colour = rng.uniform(0.0, 0.55), rng.uniform(40.0, 230.0) * rng.uniform(0.7, 1.3, 3)
        picture = picture + np.float32(haze) * (colour.astype(np.float32) - picture)
    if rng.random() < 0.2:
        picture = picture + 255 * _glare(rng, size)[..., None]
    if rng.random() < 0.15:
        veil = np.clip(_cloud(rng, size, rng.uniform(2.0, 14.0)) * 1.8 - 0.9, 0.0, 0.7)
        picture = picture + veil[..., None] * (235 - picture)
    if rng.random() < 0.12:
        # Drops in the air or on the lens: small, bright, half transparent.
        for _ in range(rng.integers(5, 60)):
            x, y = rng.integers(0, size, 2)
            radius = int(rng.integers(0, 3))
            area = picture[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]
            area += np.float32(rng.uniform(0.2, 0.9)) * (np.float32(rng.uniform(180, 255)) - area)
    return picture


def simulate_camera(rng: np.random.Generator, picture: Picture) -> UInt8[np.ndarray, "S S 3"]:
    """Optics, sensor, processing and compression of a random camera; 40 % are good cameras."""
    is_good = rng.random() < 0.4
    if rng.random() < 0.5:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.3, 1.4))
    if rng.random() < 0.15:
        picture = cv2.filter2D(picture, -1, motion_kernel(rng, rng.uniform(1.5, 6.0)))
    picture = _develop(rng, np.clip(picture, 0, 255))
    if not is_good and rng.random() < 0.4:
        picture = _enlarge(rng, picture)
    if rng.random() < 0.7:
        level = rng.uniform(0.3, 2.5 if is_good else 8.0)
        grain = (level * rng.standard_normal(picture.shape, np.float32)).astype(np.float32)
        if rng.random() < 0.4:
            grain = 1.5 * cv2.GaussianBlur(grain, (0, 0), rng.uniform(0.5, 1.0))
        picture = picture + grain
    if rng.random() < 0.2:
        blurred = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.8, 2.0))
        picture = picture + rng.uniform(0.3, 1.2) * (picture - blurred)  # unsharp masking
    pixels = np.clip(np.round(picture), 0, 255).astype(np.uint8)
    worst = 60 if is_good else 15
    return _compress(pixels, int(rng.integers(worst, 96))) if rng.random() < 0.6 else pixels


def motion_kernel(rng: np.random.Generator, length_px: float) -> Float32[np.ndarray, "K K"]:
    """Convolution kernel of a straight motion blur in a random direction; it sums to 1."""
    angle = rng.uniform(0.0, np.pi)
    reach = length_px / 2 * np.array([np.cos(angle), np.sin(angle)])
    return line_kernel(reach, int(np.ceil(length_px / 2)))


def _develop(rng: np.random.Generator, picture: Picture) -> Picture:
    """Exposure, contrast curve, white balance and saturation."""
    picture = 255 * (picture / 255) ** np.float32(np.exp(rng.normal(0.0, 0.25)))
    picture = picture * np.exp(rng.normal(0.0, 0.12, 3)).astype(np.float32)
    grey = picture.mean(axis=2, keepdims=True)
    saturation = 0.0 if rng.random() < 0.05 else rng.uniform(0.4, 1.4)
    picture = grey + np.float32(saturation) * (picture - grey)
    low, high = rng.uniform(0.0, 50.0), rng.uniform(150.0, 290.0)
    return np.clip(low + picture * np.float32((high - low) / 255), 0, 255)


def _enlarge(rng: np.random.Generator, picture: Picture) -> Picture:
    """Shrink and enlarge, as for a fish that was small in its frame."""
    size = len(picture)
    small = max(16, round(size / rng.uniform(1.0, 3.5)))
    shrunken = cv2.resize(picture, (small, small), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.5:
        pixels = np.clip(shrunken, 0, 255).astype(np.uint8)
        shrunken = _compress(pixels, int(rng.integers(30, 96))).astype(np.float32)
    return cv2.resize(shrunken, (size, size))


def _compress(pixels: UInt8[np.ndarray, "H W 3"], quality: int) -> UInt8[np.ndarray, "H W 3"]:
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))


def _glare(rng: np.random.Generator, size: int) -> Float32[np.ndarray, "S S"]:
    canvas = np.zeros((size, size), np.float32)
    for _ in range(rng.integers(1, 5)):
        center, axes = rng.integers(0, size, 2).tolist(), rng.uniform(1.0, 14.0, 2)
        axes = tuple(np.ceil(axes).astype(int).tolist())
        cv2.ellipse(canvas, center, axes, float(rng.uniform(0, 180)), 0, 360, 1.0, -1)
    strength = np.float32(rng.uniform(0.3, 1.5))
    return strength * cv2.GaussianBlur(canvas, (0, 0), rng.uniform(0.6, 4.0))


def _cloud(rng: np.random.Generator, size: int, grain: float) -> Float32[np.ndarray, "S S"]:
    """Smooth noise between 0 and 1."""
    cells = max(2, round(size / grain) + 1)
    return cv2.resize(rng.random((cells, cells), np.float32), (size, size))


_PHOTOGRAPHED_SHARE = 0.4  # of fish, and of backgrounds, if there are any; chosen by hand
_BANK_VERSION = 3  # part of the file's name; raised when fish or backgrounds are drawn differently


@dataclass(frozen=True, eq=False, kw_only=True)
class PatchBank:
    """Fish patches and backgrounds; the last of each may be photographed."""

    # BGR times coverage, and coverage; simulated heads are to the left
    fish: UInt8[np.ndarray, "F P P 4"]
    # snout and fork of the tail, x, y in the fish's patch; NaN: not marked
    ends_px: Float32[np.ndarray, "F 2 2"]
    backgrounds: UInt8[np.ndarray, "G B B 3"]
    num_photographed_fish: int = 0
    num_photographed_backgrounds: int = 0

    def draw_fish(self, rng: np.random.Generator) -> int:
        """Index of a random fish, photographed for a fixed share."""
        return _draw_index(rng, len(self.fish), self.num_photographed_fish)

    def draw_background(self, rng: np.random.Generator) -> UInt8[np.ndarray, "B B 3"]:
        """A random background, photographed for a fixed share."""
        index = _draw_index(rng, len(self.backgrounds), self.num_photographed_backgrounds)
        return self.backgrounds[index]

    def with_photographs(
        self, fish: list[FishPatch], backgrounds: list[UInt8[np.ndarray, "B B 3"]]
    ) -> "PatchBank":
        """The bank with these besides; either list may be empty."""
        ends_px = [self.ends_px, *(patch.ends_px[None] for patch in fish)]
        return replace(
            self,
            fish=np.concatenate([self.fish, *(patch.bgra[None] for patch in fish)]),
            ends_px=np.concatenate(ends_px, dtype=np.float32),
            backgrounds=np.concatenate([self.backgrounds, *(more[None] for more in backgrounds)]),
            num_photographed_fish=self.num_photographed_fish + len(fish),
            num_photographed_backgrounds=self.num_photographed_backgrounds + len(backgrounds),
        )


def _draw_index(rng: np.random.Generator, num_all: int, num_photographed: int) -> int:
    if num_photographed == 0:
        return int(rng.integers(num_all))
    num_drawn = num_all - num_photographed
    if rng.random() < _PHOTOGRAPHED_SHARE:
        return num_drawn + int(rng.integers(num_photographed))
    return int(rng.integers(num_drawn))


def make_bank(
    *, num_fish: int, num_backgrounds: int, seed: int, progress: Callable[[], None]
) -> PatchBank:
    """Draw a bank; `progress` is called after each item (about 20 ms).

    Equal seeds make equal banks.
    """
    bank = PatchBank(
        fish=np.empty((num_fish, PATCH_PX, PATCH_PX, 4), np.uint8),
        ends_px=np.empty((num_fish, 2, 2), np.float32),
        backgrounds=np.empty((num_backgrounds, BACKGROUND_PX, BACKGROUND_PX, 3), np.uint8),
    )
    for index in range(num_fish):
        patch = draw_fish_patch(np.random.default_rng((seed, 0, index)))
        bank.fish[index], bank.ends_px[index] = patch.bgra, patch.ends_px
        progress()
    for index in range(num_backgrounds):
        bank.backgrounds[index] = draw_background(np.random.default_rng((seed, 1, index)))
        progress()
    return bank


def load_or_make_bank(
    folder: Path, *, num_fish: int, num_backgrounds: int, seed: int, progress: Callable[[], None]
) -> PatchBank:
    """The bank of these numbers from its file in `folder`; drawn and written if missing."""
    path = folder / f"bank-{_BANK_VERSION}-{num_fish}-{num_backgrounds}-{seed}.npz"
    if path.exists():
        with np.load(path) as arrays:
            return PatchBank(**arrays)
    numbers = {"num_fish": num_fish, "num_backgrounds": num_backgrounds, "seed": seed}
    bank = make_bank(**numbers, progress=progress)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft, draft.open("wb") as file:
        np.savez(file, fish=bank.fish, ends_px=bank.ends_px, backgrounds=bank.backgrounds)
    return bank
