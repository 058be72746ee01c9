"""The fish and backgrounds that training pictures are composed of: simulated, and photographed.

The simulated ones are cached in a file.
"""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from stream_dmr.segmentation.training.fish_patches import PATCH_PX, draw_fish_patch
from stream_dmr.segmentation.training.random_backgrounds import BACKGROUND_PX, draw_background

_PHOTOGRAPHED_SHARE = 0.4  # of fish, and of backgrounds, where there are any; chosen by hand
_BANK_VERSION = 3  # part of the file's name; raised when fish or backgrounds are drawn differently


@dataclass(frozen=True, eq=False, kw_only=True)
class PatchBank:
    """Fish patches and backgrounds; the last ones of each may be photographed."""

    # BGR times coverage, and coverage; simulated heads are to the left
    fish: UInt8[np.ndarray, "F P P 4"]
    # snout and fork of the tail, x, y in the fish's patch; NaN: unknown, as of photographed fish
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
        self, fish: list[UInt8[np.ndarray, "P P 4"]], backgrounds: list[UInt8[np.ndarray, "B B 3"]]
    ) -> "PatchBank":
        """The bank with these besides; either list may be empty."""
        unknown = np.full((len(fish), 2, 2), np.nan, np.float32)
        return PatchBank(
            fish=np.concatenate([self.fish, *(one[None] for one in fish)]),
            ends_px=np.concatenate([self.ends_px, unknown]),
            backgrounds=np.concatenate([self.backgrounds, *(one[None] for one in backgrounds)]),
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

    Equal seeds give equal banks.
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
    bank = make_bank(
        num_fish=num_fish, num_backgrounds=num_backgrounds, seed=seed, progress=progress
    )
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, suffix=".npz", delete=False) as file:
        np.savez(file, fish=bank.fish, ends_px=bank.ends_px, backgrounds=bank.backgrounds)
    os.replace(file.name, path)  # atomic: other processes never read half a file
    return bank
