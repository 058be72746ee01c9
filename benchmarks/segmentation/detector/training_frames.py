"""Frames with boxes around their fish: photographs, and fish put before backgrounds."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from benchmarks.segmentation.clone import Clone
from benchmarks.segmentation.mask_proposer import box_of
from benchmarks.segmentation.real_images import (
    first_versions,
    is_of,
    labelled_boxes,
    labels_of,
    without_padding,
)
from stream_dmr.training.annotated_images import read_annotated_images
from stream_dmr.training.image_degradation import PatchBank, add_weather, simulate_camera
from stream_dmr.training.surroundings import draw_board, draw_occluders, with_thing

SIDE_PX = 448  # of a training frame: between the sides of a detector's input
_KEPT_PX = 640  # longer side of the photographs that are kept in memory
_FRAME_SHARE, _SINGLE_SHARE = 0.45, 0.1  # of the examples; the others are put together
_MOSAIC_SHARE, _MORE_FISH_SHARE = 0.25, 0.25  # of the examples from frames
_TURNED_SHARE, _WATER_SHARE = 0.25, 0.3  # of all examples
_BOARD_SHARE, _ON_BOARD_SHARE = 0.3, 0.85  # of examples put together; of boards, with a fish
_SIZES_PX = (18.0, 560.0)  # of fish put before a background
# Of those: how many are slimmer, as eels and gars are, or fish seen edge-on; their least depth.
_SLIM_SHARE, _SLIMMEST = 0.15, 0.4
_LONGEST_ROW, _ROW_LENGTHS = 14, (0.08, 0.7)  # of fish side by side; of the picture's side
_EMPTY_SHARE, _ROW_SHARE = 0.1, 0.35  # of backgrounds without a board
_MOST_FISH = 12
_MIN_VISIBLE = 0.35  # of a fish; with less it has no box
_MIN_BOX_PX = 5.0
_GREY = 114.0  # beyond a photograph's edges

Image = UInt8[np.ndarray, "H W 3"]
Boxes = Float[np.ndarray, "N 4"]  # left, top, right, bottom, px


@dataclass(frozen=True, eq=False)
class AnnotatedFrame:
    """A photograph and the boxes of all fish in it."""

    image: Image
    boxes: Boxes
    name: str = ""


@dataclass(frozen=True, eq=False)
class FrameSource:
    """Draws training frames; a class, since worker processes receive it pickled."""

    frames: list[list[AnnotatedFrame]]  # by source
    singles: list[AnnotatedFrame]
    bank: PatchBank

    def __call__(self, rng: np.random.Generator) -> tuple[UInt8[np.ndarray, "S S 3"], Boxes]:
        """A frame of `SIDE_PX` and its boxes."""
        kind = rng.random()
        if kind < _FRAME_SHARE:
            picture, boxes = self._from_frames(rng)
        elif kind < _FRAME_SHARE + _SINGLE_SHARE:
            picture, boxes = _zoomed(rng, self.singles[rng.integers(len(self.singles))])
        else:
            picture, boxes = _composed(rng, self.bank)
        picture, boxes = _turned(rng, picture, boxes)
        if rng.random() < _WATER_SHARE:
            picture = _under_water(rng, picture)
        if rng.random() < 0.4:
            picture = add_weather(rng, picture)
        if rng.random() < 0.7:
            return simulate_camera(rng, picture), boxes
        return np.clip(np.round(picture), 0, 255).astype(np.uint8), boxes

    def _from_frames(self, rng: np.random.Generator) -> tuple[Float32[np.ndarray, "S S 3"], Boxes]:
        """A photograph, four of them, or one with fish of the bank before it."""
        kind = rng.random()
        if kind < _MOSAIC_SHARE:
            return _mosaic(rng, [self._draw_frame(rng) for _ in range(4)])
        picture, boxes = _zoomed(rng, self._draw_frame(rng))
        if kind < _MOSAIC_SHARE + _MORE_FISH_SHARE:
            return _with_fish(rng, picture, boxes, self.bank, count=int(rng.integers(1, 5)))
        return picture, boxes

    def _draw_frame(self, rng: np.random.Generator) -> AnnotatedFrame:
        """Of a source with four times as many frames, twice as often."""
        shares = np.sqrt([len(frames) for frames in self.frames])
        frames = self.frames[rng.choice(len(shares), p=shares / shares.sum())]
        return frames[rng.integers(len(frames))]


def read_frames(repositories: Path, source: dict[str, Any], *, every: int) -> list[AnnotatedFrame]:
    """Every so many pictures of a source with boxes; its classes `fish_classes` are fish."""
    clone = Clone(repositories, source["repository"], source["commit"])
    frames = []
    for path in list(first_versions(clone.paths(source["files"])).values())[::every]:
        image = without_padding(clone.image(path), source.get("sizes_before_padding", []))
        fish = source.get("fish_classes", source["classes"])
        found = labelled_boxes(clone, labels_of(path, source), image)
        boxes = np.array([box for kind, box in found if is_of(kind, fish)]).reshape(-1, 4)
        top, bottom, left, right = source.get("area", [0, image.shape[0], 0, image.shape[1]])
        inside = (boxes - [left, top, left, top]).clip(0, np.tile([right - left, bottom - top], 2))
        frames.append(_kept(image[top:bottom, left:right], inside, Path(path).stem))
    return frames


def read_singles(images: Path, masks: Path, *, sources: list[str]) -> list[AnnotatedFrame]:
    """Photographs of single fish with masks, of the sources whose names these are."""
    return [
        _kept(one.image, np.array([box_of(mask) for mask in one.masks]))
        for one in read_annotated_images(images, masks)
        if one.path.stem.split("-")[0] in sources
    ]


def _kept(image: Image, boxes: Boxes, name: str = "") -> AnnotatedFrame:
    scale = min(1.0, _KEPT_PX / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return AnnotatedFrame(small, boxes * scale, name)


def _zoomed(
    rng: np.random.Generator, frame: AnnotatedFrame, *, side: int = SIDE_PX
) -> tuple[Float32[np.ndarray, "S S 3"], Boxes]:
    """A part of a photograph, or all of it and what is around it in grey."""
    height, width = frame.image.shape[:2]
    whole = side / max(height, width)
    zoom = whole * np.exp(rng.uniform(np.log(0.6), np.log(3.0)))
    scale = zoom * np.exp(rng.normal(0.0, 0.08, 2))
    size = np.maximum(1, np.round(scale * [width, height])).astype(int)
    usual = cv2.INTER_AREA if zoom < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(frame.image, tuple(size.tolist()), interpolation=usual)
    room = side - size
    shift = np.round(np.minimum(room, 0) + rng.random(2) * np.abs(room))
    affine = np.column_stack([np.eye(2), shift])
    picture = cv2.warpAffine(
        resized, affine, (side, side), flags=cv2.INTER_NEAREST, borderValue=(_GREY,) * 3
    )
    moved = frame.boxes * np.tile(size / [width, height], 2) + np.tile(shift, 2)
    inside = moved.clip(0, side)
    visible = _areas(inside) / np.maximum(_areas(moved), 1e-6)
    return picture.astype(np.float32), inside[(visible > _MIN_VISIBLE) & _are_large(inside)]


def _composed(
    rng: np.random.Generator, bank: PatchBank
) -> tuple[Float32[np.ndarray, "S S 3"], Boxes]:
    """Fish of many sizes before a background, those drawn later before the others."""
    background = bank.draw_background(rng)
    side = int(rng.uniform(0.5, 1.0) * len(background))
    row, column = rng.integers(0, len(background) - side + 1, 2)
    part = background[row : row + side, column : column + side]
    picture = cv2.resize(part, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_LINEAR)
    if rng.random() < _BOARD_SHARE:
        return _on_board(rng, picture.astype(np.float32), bank)
    count = int(rng.integers(0, _MOST_FISH + 1) if rng.random() < 0.6 else rng.integers(0, 4))
    kind = rng.random()
    if kind < _ROW_SHARE:
        return _with_layers(rng, _as_deck(rng, picture), np.zeros((0, 4)), _row(rng, bank))
    if kind < _ROW_SHARE + _EMPTY_SHARE:
        count = 0
    return _with_fish(rng, picture.astype(np.float32), np.zeros((0, 4)), bank, count=count)


def _on_board(
    rng: np.random.Generator, picture: Float32[np.ndarray, "S S 3"], bank: PatchBank
) -> tuple[Float32[np.ndarray, "S S 3"], Boxes]:
    """A measuring board before a picture, mostly with one fish on it; perhaps a hand, a pole."""
    length = rng.uniform(0.25, 0.9) * SIDE_PX
    angle_deg = rng.normal(0.0, 12.0)
    if rng.random() < 0.3:
        angle_deg = rng.uniform(0, 360)
    middle = rng.uniform(0.35, 0.65, 2) * SIDE_PX
    from_scene = np.column_stack([length * np.eye(2), middle])
    for thing in draw_board(rng, -np.radians(angle_deg)):
        picture, _ = with_thing(picture, thing, from_scene)
    is_fish = np.zeros((SIDE_PX, SIDE_PX), bool)
    if rng.random() < _ON_BOARD_SHARE:
        angle_deg += 180 * rng.integers(2)
        layer = _fish_at(bank.fish[bank.draw_fish(rng)], length, angle_deg, middle)
        picture, is_fish = _with_layer(rng, picture, layer)
    area = int(is_fish.sum())
    for thing in draw_occluders(rng) if rng.random() < 0.5 else []:
        picture, hidden = with_thing(picture, thing, from_scene)
        is_fish &= hidden < 0.5
    is_shown = is_fish.any() and is_fish.sum() > _MIN_VISIBLE * area
    boxes = np.array([box_of(is_fish)], np.float64) if is_shown else np.zeros((0, 4))
    return picture.clip(0, 255).astype(np.float32), boxes


def _with_layer(
    rng: np.random.Generator,
    picture: Float32[np.ndarray, "S S 3"],
    layer: Float32[np.ndarray, "S S 4"],
) -> tuple[Float32[np.ndarray, "S S 3"], Bool[np.ndarray, "S S"]]:
    """The picture with a fish before it, a little darker or lighter, and where the fish is."""
    cover = layer[..., 3:] / 255
    is_here = cover[..., 0] > 0.5
    return picture * (1 - cover) + layer[..., :3] * rng.uniform(0.7, 1.2), is_here


def _mosaic(
    rng: np.random.Generator, frames: list[AnnotatedFrame]
) -> tuple[Float32[np.ndarray, "S S 3"], Boxes]:
    """Four photographs side by side: many and small fish."""
    half = SIDE_PX // 2
    picture, boxes = np.zeros((SIDE_PX, SIDE_PX, 3), np.float32), []
    for index, frame in enumerate(frames):
        row, column = divmod(index, 2)
        part, found = _zoomed(rng, frame, side=half)
        picture[row * half : (row + 1) * half, column * half : (column + 1) * half] = part
        boxes.append(found + np.tile([column * half, row * half], 2))
    return picture, np.concatenate(boxes)


def _with_fish(
    rng: np.random.Generator,
    picture: Float32[np.ndarray, "S S 3"],
    boxes: Boxes,
    bank: PatchBank,
    *,
    count: int,
) -> tuple[Float32[np.ndarray, "S S 3"], Boxes]:
    """Fish of the bank, of similar sizes, before a picture."""
    usual = np.exp(rng.uniform(*np.log(_SIZES_PX)))
    sizes = np.clip(usual * np.exp(rng.normal(0.0, 0.35, count)), *_SIZES_PX)
    layers = (_placed_fish(rng, bank, size) for size in sizes)
    return _with_layers(rng, picture, boxes, layers)


def _as_deck(rng: np.random.Generator, picture: Image) -> Float32[np.ndarray, "S S 3"]:
    """A picture that mostly fades into one pale or dark colour, as of a deck or a table."""
    plain = rng.uniform(0.0, 1.0) * (rng.random() < 0.7)
    colour = np.clip(rng.uniform(40, 250) + rng.normal(0, 12, 3), 0, 255)
    return ((1 - plain) * picture + plain * colour).astype(np.float32)


def _row(rng: np.random.Generator, bank: PatchBank) -> Iterator[Float32[np.ndarray, "S S 4"]]:
    """A catch that is laid out: fish side by side, alike, close, mostly parallel."""
    count = int(rng.integers(2, _LONGEST_ROW + 1))
    patches = bank.fish[[bank.draw_fish(rng) for _ in range(rng.integers(1, 4))]]
    depth = np.ptp(np.nonzero((patches[0, ..., 3] > 127).any(axis=1))[0]) / patches.shape[1]
    slimness = _slimness(rng)
    length = np.exp(rng.uniform(*np.log(_ROW_LENGTHS))) * SIDE_PX
    step = max(rng.uniform(0.75, 1.5) * depth * slimness * length, 3.0)
    angle_deg = rng.uniform(0, 360) if rng.random() < 0.3 else rng.normal(0, 15)
    down = np.array([np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))])
    middle = rng.uniform(0.2, 0.8, 2) * SIDE_PX
    heads_deg = 180 * rng.integers(2)
    for place in step * (np.arange(count) - (count - 1) / 2):
        patch = patches[rng.integers(len(patches))]
        turned_deg = angle_deg + rng.normal(0, 6)
        turned_deg += 180 - heads_deg if rng.random() < 0.1 else heads_deg
        at = middle + place * down + rng.normal(0, 0.05 * length, 2)
        size = length * np.exp(rng.normal(0, 0.08))
        yield _fish_at(patch, size, turned_deg, at, slimness=slimness)


def _with_layers(
    rng: np.random.Generator,
    picture: Float32[np.ndarray, "S S 3"],
    boxes: Boxes,
    layers: Iterable[Float32[np.ndarray, "S S 4"]],
) -> tuple[Float32[np.ndarray, "S S 3"], Boxes]:
    """Fish before a picture; those in it that they hide have no box any more."""
    owner = np.full((SIDE_PX, SIDE_PX), -1)
    areas = []
    for index, layer in enumerate(layers):
        picture, is_here = _with_layer(rng, picture, layer)
        owner[is_here] = index
        areas.append(int(is_here.sum()))
    added = [
        box_of(owner == index)
        for index, area in enumerate(areas)
        if area and (owner == index).sum() > _MIN_VISIBLE * area
    ]
    kept = [box for box in boxes if _free_share(owner >= 0, box) > 1 - _MIN_VISIBLE]
    found = np.array(kept + added, np.float64).reshape(-1, 4)
    return picture.clip(0, 255).astype(np.float32), found[_are_large(found)]


def _free_share(is_covered: np.ndarray, box: np.ndarray) -> float:
    x0, y0 = np.floor(box[:2]).astype(int)
    x1, y1 = np.ceil(box[2:]).astype(int)
    part = is_covered[y0:y1, x0:x1]
    return 1 - float(part.mean()) if part.size else 0.0


def _turned(
    rng: np.random.Generator, picture: Float32[np.ndarray, "S S 3"], boxes: Boxes
) -> tuple[Float32[np.ndarray, "S S 3"], Boxes]:
    """Mirrored, and some on their side, as fish that hang or are seen from above."""
    if rng.random() < 0.5:
        picture, boxes = picture[:, ::-1], boxes.copy()
        boxes[:, [0, 2]] = SIDE_PX - boxes[:, [2, 0]]
    if rng.random() < _TURNED_SHARE:
        picture, boxes = picture.transpose(1, 0, 2), boxes[:, [1, 0, 3, 2]]
    return np.ascontiguousarray(picture), boxes


def _under_water(
    rng: np.random.Generator, picture: Float32[np.ndarray, "S S 3"]
) -> Float32[np.ndarray, "S S 3"]:
    """Water takes light, of one colour more than of another, and contrast."""
    light = np.exp(rng.normal(-0.25, 0.35, 3)).astype(np.float32)
    murk = (rng.uniform(20.0, 200.0) * light).astype(np.float32)
    clear = np.float32(rng.uniform(0.35, 1.0))
    return (clear * picture * light + (1 - clear) * murk).clip(0, 255).astype(np.float32)


def _placed_fish(
    rng: np.random.Generator, bank: PatchBank, size: float
) -> Float32[np.ndarray, "S S 4"]:
    """A fish of that length at a random place: BGR times coverage, and coverage."""
    angle_deg = rng.normal(0.0, 25.0) + 180 * rng.integers(2)
    if rng.random() < 0.3:
        angle_deg = rng.uniform(0, 360)
    slimness = _slimness(rng)
    at = rng.uniform(-0.1, 1.1, 2) * SIDE_PX
    return _fish_at(bank.fish[bank.draw_fish(rng)], size, angle_deg, at, slimness=slimness)


def _slimness(rng: np.random.Generator) -> float:
    return rng.uniform(_SLIMMEST, 1.0) if rng.random() < _SLIM_SHARE else 1.0


def _fish_at(
    patch: UInt8[np.ndarray, "P P 4"],
    size: float,
    angle_deg: float,
    at: Float[np.ndarray, "2"],
    *,
    slimness: float = 1.0,
) -> Float32[np.ndarray, "S S 4"]:
    side = patch.shape[0]
    affine = cv2.getRotationMatrix2D((0.0, 0.0), angle_deg, size / side)
    affine[:, 1] *= slimness
    affine[:, 2] = at - affine[:, :2] @ (side / 2, side / 2)
    shrink = int(side / size)
    if shrink > 1:  # average pixels that would be skipped
        patch = cv2.blur(patch, (shrink, shrink))
    return cv2.warpAffine(patch, affine, (SIDE_PX, SIDE_PX), flags=cv2.INTER_LINEAR).astype(
        np.float32
    )


def _areas(boxes: Boxes) -> Float[np.ndarray, "N"]:
    return (boxes[:, 2:] - boxes[:, :2]).clip(0).prod(axis=1)


def _are_large(boxes: Boxes) -> np.ndarray:
    return (boxes[:, 2:] - boxes[:, :2]).max(axis=1, initial=0.0) >= _MIN_BOX_PX
