"""The simulated fish and backgrounds that training pictures are composed of, cached in a file."""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from stream_dmr.segmentation.training.fish_patches import PATCH_PX, draw_fish_patch
from stream_dmr.segmentation.training.random_backgrounds import BACKGROUND_PX, draw_background

_BANK_VERSION = 2  # part of the file's name; raised when fish or backgrounds are drawn differently


@dataclass(frozen=True, eq=False, kw_only=True)
class PatchBank:
    """Fish patches and backgrounds."""

    fish: UInt8[np.ndarray, "F P P 4"]  # BGR times coverage, and coverage; head to the left
    ends_px: Float32[np.ndarray, "F 2 2"]  # snout and fork of the tail, x, y in the fish's patch
    backgrounds: UInt8[np.ndarray, "G B B 3"]


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
