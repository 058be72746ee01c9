"""The fish and backgrounds that training pictures are put together from, drawn once and kept."""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from stream_dmr.segmentation.training.fish_patches import PATCH_PX, draw_fish_patch
from stream_dmr.segmentation.training.random_backgrounds import BACKGROUND_PX, draw_background

BANK_VERSION = 2
"""Part of the file's name; raise it when fish or backgrounds are drawn otherwise."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Bank:
    """Parts of pictures."""

    fish: UInt8[np.ndarray, "F P P 4"]  # BGR times coverage, and coverage; head to the left
    ends_px: Float32[np.ndarray, "F 2 2"]  # snout and fork of the tail in the fish's patch
    backgrounds: UInt8[np.ndarray, "G B B 3"]


def make_bank(
    *, num_fish: int, num_backgrounds: int, seed: int, progress: Callable[[], None]
) -> Bank:
    """Draw a bank, some 20 ms an item; `progress` is called after each. Equal seeds give equals."""
    bank = Bank(
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
) -> Bank:
    """The bank of these numbers from `folder`, which it is written to where it isn't there yet."""
    path = folder / f"bank-{BANK_VERSION}-{num_fish}-{num_backgrounds}-{seed}.npz"
    if path.exists():
        with np.load(path) as arrays:
            return Bank(**arrays)
    bank = make_bank(
        num_fish=num_fish, num_backgrounds=num_backgrounds, seed=seed, progress=progress
    )
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, suffix=".npz", delete=False) as file:
        np.savez(file, fish=bank.fish, ends_px=bank.ends_px, backgrounds=bank.backgrounds)
    os.replace(file.name, path)  # another process sees all of it or nothing
    return bank
