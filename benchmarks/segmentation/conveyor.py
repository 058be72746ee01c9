"""How real fish on a moving belt are counted: cut out of photographs, carried through the picture.

    python -m benchmarks.segmentation.conveyor DATA --seed 100

DATA as for `real_images`; the fish are the held-out ones that were photographed out of water. The
belt is plain, with seams and grain, or itself a photograph, which is much harder: all of it moves.
Around it is a photograph that does not. Speeds are in pixels a frame, of 1280 x 720.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from benchmarks.segmentation.mask_proposer import box_of
from benchmarks.segmentation.tracking import HEADER, MIN_VISIBLE_FRACTION, Shot, follow, table_row
from stream_dmr.training.annotated_images import list_images, read_annotated_images, read_image

_OUT_OF_WATER = ("anglers", "catfish", "counter")
_NUM_FISH = 10
_WIDTH, _HEIGHT = 1280, 720
_BELT = slice(150, 570)  # rows
_LENGTHS_PX, _GAPS_PX = (220.0, 380.0), (350.0, 800.0)
_SEAMS_PX = 160

Image = UInt8[np.ndarray, "H W 3"]


class Fish(NamedTuple):
    """A fish on the belt: BGR and mask, and the column and row of its first pixel."""

    picture: UInt8[np.ndarray, "h w 4"]
    left: int
    top: int


def shots(
    cutouts: list[UInt8[np.ndarray, "h w 4"]],
    photographs: list[Path],
    *,
    kind: str,
    speed: int,
    rng: np.random.Generator,
) -> Iterator[Shot]:
    """Ten fish, one after the other, that come in at the left and leave at the right."""
    start = np.cumsum(rng.uniform(*_GAPS_PX, _NUM_FISH)).astype(int)
    belt = _belt(start[-1] + 2 * _WIDTH, kind, photographs, rng)
    fish = [_put_on(belt, cutouts[rng.integers(len(cutouts))], _WIDTH + x, rng) for x in start]
    room = cv2.resize(read_image(photographs[rng.integers(len(photographs))]), (_WIDTH, _HEIGHT))
    for left in range(belt.shape[1] - _WIDTH, 0, -speed):
        image = room.copy()
        image[_BELT] = belt[:, left : left + _WIDTH]
        noise = rng.normal(0.0, 3.0, image.shape)
        boxes = {i: box for i, one in enumerate(fish, 1) if (box := _box(one, left)) is not None}
        yield Shot(np.clip(image + noise, 0, 255).astype(np.uint8), boxes)


def _belt(length: int, kind: str, photographs: list[Path], rng: np.random.Generator) -> Image:
    height = _BELT.stop - _BELT.start
    if kind == "photograph":
        picture = cv2.resize(read_image(photographs[rng.integers(len(photographs))]), (640, height))
        pair = np.hstack([picture, picture[:, ::-1]])
        return np.tile(pair, (1, -(-length // pair.shape[1]), 1))[:, :length].copy()
    belt = np.full((height, length, 3), rng.integers(60, 200, 3), np.float64)
    for seam in range(0, length, _SEAMS_PX):
        belt[:, seam : seam + 4] *= 0.8
    return np.clip(belt + rng.normal(0.0, 6.0, belt.shape[:2])[..., None], 0, 255).astype(np.uint8)


def _put_on(
    belt: Image, cutout: UInt8[np.ndarray, "h w 4"], left: int, rng: np.random.Generator
) -> Fish:
    """Paste a fish in, turned at random."""
    height, width = cutout.shape[:2]
    scale = rng.uniform(*_LENGTHS_PX) / max(height, width)
    side = round(scale * float(np.hypot(height, width))) + 2
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), rng.uniform(-180.0, 180.0), scale)
    turn[:, 2] += side / 2 - np.array([width, height]) / 2
    if scale < 0.5:
        cutout = cv2.blur(cutout, (round(1 / scale),) * 2)
    turned = cv2.warpAffine(cutout, turn, (side, side))
    x, y, width, height = cv2.boundingRect((turned[..., 3] > 127).astype(np.uint8))
    picture = turned[y : y + height, x : x + width][: belt.shape[0]]
    top = int(rng.integers(belt.shape[0] - picture.shape[0] + 1))
    place = belt[top : top + picture.shape[0], left : left + width]
    opacity = picture[..., 3:] / 255.0
    place[:] = np.round(place * (1 - opacity) + picture[..., :3] * opacity)
    return Fish(picture, left, top)


def _box(fish: Fish, left: int) -> np.ndarray | None:
    """Its box in the frame whose first column is the belt's `left`; None where it is not in it."""
    start = fish.left - left
    mask = fish.picture[:, max(0, -start) : max(0, _WIDTH - start), 3] > 127
    visible = np.count_nonzero(mask)
    if visible < max(1.0, MIN_VISIBLE_FRACTION * np.count_nonzero(fish.picture[..., 3] > 127)):
        return None
    return box_of(mask) + np.tile([max(0, start), fish.top + _BELT.start], 2)


def read_cutouts(data: Path) -> list[UInt8[np.ndarray, "h w 4"]]:
    """BGR and mask of the held-out fish that lay out of water."""
    cutouts = []
    for annotated in read_annotated_images(data / "images", data / "masks"):
        if annotated.path.stem.startswith(_OUT_OF_WATER):
            for mask in annotated.masks:
                left, top, right, bottom = box_of(mask).astype(int)
                layers = np.dstack([annotated.image, mask * np.uint8(255)])
                cutouts.append(layers[top:bottom, left:right])
    return cutouts


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--seed", type=int, default=100, help="of the first belt of each kind")
    parser.add_argument("--belts", type=int, default=2, help="of each kind")
    arguments = parser.parse_args()
    cutouts = read_cutouts(arguments.data / "held-out")
    photographs = list(list_images(arguments.data / "backgrounds").values())
    print(HEADER)
    for kind in ("plain", "photograph"):
        for speed in (8, 20):
            outcomes = []
            for seed in range(arguments.seed, arguments.seed + arguments.belts):
                rng = np.random.default_rng(seed)
                filmed = shots(cutouts, photographs, kind=kind, speed=speed, rng=rng)
                outcomes.append(follow(filmed, camera=None))
            print(table_row(f"{kind}, {speed} px a frame", outcomes), flush=True)


if __name__ == "__main__":
    main()
