"""Training examples: drawn one by one, read in batches.

The order is that of a real crop: a scene, the visible part of its target fish, a box around that
with a detector's errors, and the crop around the box.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from stream_dmr.geometry import transformed
from stream_dmr.networks.unet_interface import SIZES_PX, box_coverage
from stream_dmr.training.image_degradation import PatchBank, add_weather, simulate_camera
from stream_dmr.training.surroundings import draw_into
from stream_dmr.training.training_scene import (
    TrainingScene,
    draw_scene,
    frame_coverage,
    render_scene,
    warp_fish,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingSample:
    """A crop with its true mask and ends, at the network's input size."""

    image: UInt8[np.ndarray, "S S 3"]  # BGR
    mask: Float32[np.ndarray, "S S"]  # fraction of each pixel that is fish, 0 to 1
    in_box: Float32[np.ndarray, "S S"]  # see `box_coverage`; all 1: the mask is of all fish
    ends_px: Float32[np.ndarray, "2 2"] | None  # head and tail, may lie outside; None: unknown


Draw = Callable[[np.random.Generator, int], TrainingSample]  # of so many pixels a side
Batch = tuple[
    UInt8[Tensor, "B S S 3"],  # images, BGR
    Float32[Tensor, "B S S"],  # masks
    Float32[Tensor, "B S S"],  # in_box
    Float32[Tensor, "B 2 2"],  # ends in px; NaN: unknown
]


_SMALL_PX, *_LARGER_PX = SIZES_PX
# Every other batch is of the size that videos are cut out at.
_TURNS_PX = tuple(px for larger in _LARGER_PX for px in (_SMALL_PX, larger))


class SampleDataset(Dataset[TrainingSample]):
    """`size` random examples, drawn on demand: equal seeds draw equal ones, so a run can resume.

    The pictures of a batch have the same size; batches take the sizes of `_TURNS_PX` in turn.
    """

    def __init__(self, draw: Draw, *, size: int, batch_size: int, seed: tuple[int, ...]) -> None:
        self._draw, self._size, self._seed = draw, size, seed
        self.batch_size = min(batch_size, size)

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, index: int) -> TrainingSample:
        size_px = _TURNS_PX[index // self.batch_size % len(_TURNS_PX)]
        return self._draw(np.random.default_rng((*self._seed, index)), size_px)


def load_batches(samples: SampleDataset, *, workers: int) -> DataLoader[TrainingSample]:
    """Batches in order; an incomplete last batch is dropped, unless it is the only one."""
    return DataLoader(
        samples,
        batch_size=samples.batch_size,
        num_workers=workers,
        collate_fn=collate_samples,
        drop_last=True,
    )


def collate_samples(samples: list[TrainingSample]) -> Batch:
    unknown = np.full((2, 2), np.nan, np.float32)
    ends_px = [unknown if sample.ends_px is None else sample.ends_px for sample in samples]
    return (
        torch.from_numpy(np.stack([sample.image for sample in samples])),
        torch.from_numpy(np.stack([sample.mask for sample in samples])),
        torch.from_numpy(np.stack([sample.in_box for sample in samples])),
        torch.from_numpy(np.stack(ends_px)),
    )


def crop_affine(
    bbox_xyxy: Float[np.ndarray, "4"], *, margin: float, size: int
) -> Float[np.ndarray, "2 3"]:
    """The affine map from points to pixels (centers at integers) of a square crop around a box.

    `margin` is the room on each side, as a fraction of the box's longer side; `size` in px.
    """
    low, high = bbox_xyxy[:2], bbox_xyxy[2:]
    scale = size / (max(float((high - low).max()), 1e-6) * (1 + 2 * margin))
    shift = (size - 1) / 2 - scale * (low + high) / 2
    return np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])


def jitter_box(
    rng: np.random.Generator, bbox_xyxy: Float[np.ndarray, "4"], *, limits: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "4"]:
    """A box with random errors, clipped to `limits`: some per cent, for one box in three far more.

    Detectors miss thin tails, and include pieces of line or gaff; one box in ten ends at the root
    of a tail, or before a head.
    """
    low, high = bbox_xyxy[:2], bbox_xyxy[2:]
    sides = np.tile(high - low, 2)
    spread = 0.10 if rng.random() < 0.12 else rng.uniform(0.0, 0.04)
    moved = bbox_xyxy + sides * rng.laplace(0.0, spread / np.sqrt(2), 4).clip(-0.2, 0.2)
    if rng.random() < 0.1:
        edge = int(sides[1] > sides[0]) + 2 * rng.integers(2)  # across the longer side
        moved[edge] += (-1 if edge >= 2 else 1) * rng.uniform(0.06, 0.25) * sides[edge]
    elif rng.random() < 0.25:
        edge, outwards = rng.integers(4), rng.uniform(-0.25, 0.5)
        offset = outwards * (sides.max() if outwards > 0 else sides[edge])
        moved[edge] += offset if edge >= 2 else -offset
    return np.clip(moved, np.tile(limits[:2], 2), np.tile(limits[2:], 2))


def draw_part_box(
    rng: np.random.Generator, bbox_xyxy: Float[np.ndarray, "4"], points: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, "4"]:
    """A box within a box, with 25 to 60 % of its sides, around one of the points as far as it fits.

    Blobs of motion often cover a fin or half a body of a large fish only.
    """
    low, high = bbox_xyxy[:2], bbox_xyxy[2:]
    sides = rng.uniform(0.25, 0.6, 2) * (high - low)
    corner = np.clip(points[rng.integers(len(points))] - sides / 2, low, high - sides)
    return np.concatenate([corner, corner + sides])


_FINE_PX, _COARSE_PX = 2.0, 24.0  # blurs whose difference stands out at the size of fish; chosen
_SIDES_PX = (16, 160)  # shortest and longest box; a background has 256 px


def draw_spot_sample(
    rng: np.random.Generator, bank: PatchBank, *, size_px: int
) -> TrainingSample | None:
    """A crop around a spot of a background, with an empty mask; None if nothing stands out."""
    background = bank.draw_background(rng)
    spot = find_spot(rng, background)
    if spot is None:
        return None
    edges = np.array([0, 0, background.shape[1], background.shape[0]]) - 0.5
    box = jitter_box(rng, spot, limits=edges)
    affine = crop_affine(box, margin=rng.uniform(0.08, 0.22), size=size_px)
    size = (size_px, size_px)
    crop = cv2.warpAffine(background, affine, size, borderMode=cv2.BORDER_REFLECT)
    image = simulate_camera(rng, add_weather(rng, crop.astype(np.float32)))
    edges = transformed(box.reshape(2, 2), affine) + 0.5
    return TrainingSample(
        image=np.ascontiguousarray(image),
        mask=np.zeros(size, np.float32),
        in_box=box_coverage(edges.ravel(), size=size_px),
        ends_px=None,
    )


def find_spot(
    rng: np.random.Generator, background: UInt8[np.ndarray, "B B 3"]
) -> Float[np.ndarray, "4"] | None:
    """The box of a shape that differs from its surroundings, likely a large shape; or None."""
    lab = cv2.cvtColor(background, cv2.COLOR_BGR2LAB).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(lab, (0, 0), sigma) for sigma in (_FINE_PX, _COARSE_PX))
    contrast = np.linalg.norm(fine - coarse, axis=2)
    least = max(10.0, 0.4 * float(contrast.max()))  # beside a spot, `coarse` differs as well
    stands_out = contrast > max(least, float(np.quantile(contrast, rng.uniform(0.8, 0.95))))
    _, _, stats, _ = cv2.connectedComponentsWithStats(stands_out.astype(np.uint8))
    boxes = stats[1:, :4]
    longest = boxes[:, 2:].max(axis=1, initial=0)
    boxes = boxes[(longest >= _SIDES_PX[0]) & (longest <= _SIDES_PX[1])]
    if not len(boxes):
        return None
    areas = boxes[:, 2:].prod(axis=1)
    x, y, width, height = rng.choice(boxes, p=areas / areas.sum())
    return np.array([x, y, x + width, y + height]) - 0.5


_OVERVIEW_PX = 96  # of a coarse rendering of the scene, in which the boxes are found
_OVERVIEW = np.array([-1.0, -1.0, 1.0, 1.0])  # scene units
_NO_BOX_SHARE = 0.12  # of the examples: no box, the mask is of all fish
_NO_FISH_SHARE = 0.10  # of the examples: the box is around no fish, as detectors' boxes may be
_SPOT_SHARE = 0.45  # of those without a fish: around a spot that stands out in a background
PART_SHARE = 0.055  # of the examples: the box is around a part of the fish
_MIN_VISIBLE = 0.2  # of the target fish; with less visible the scene is drawn again


def draw_sample(rng: np.random.Generator, size_px: int, *, bank: PatchBank) -> TrainingSample:
    """One crop, `size_px` wide and high, with its true mask and ends."""
    kind = rng.random()
    is_boxed, is_empty = kind >= _NO_BOX_SHARE, kind >= 1 - _NO_FISH_SHARE
    is_part = not is_empty and kind >= 1 - _NO_FISH_SHARE - PART_SHARE
    if (
        is_empty
        and rng.random() < _SPOT_SHARE
        and (spot := draw_spot_sample(rng, bank, size_px=size_px))
    ):
        return spot
    while True:
        scene = draw_scene(rng, bank)
        box = _empty_box(rng, bank, scene) if is_empty else _visible_box(rng, bank, scene, is_part)
        if box is not None:
            break
    box = jitter_box(rng, box, limits=scene.frame)
    targets = [] if is_empty else [scene.target]
    if is_boxed:
        crop_from_scene = crop_affine(box, margin=rng.uniform(0.08, 0.22), size=size_px)
    else:
        center, side = rng.normal(0.0, 0.35, 2), rng.uniform(0.9, 3.2)
        anywhere = np.concatenate([center - side / 2, center + side / 2])
        crop_from_scene = crop_affine(anywhere, margin=0.0, size=size_px)
        targets = scene.fish
    picture, mask = render_scene(
        rng, bank, scene, crop_from_scene, targets=targets, size_px=size_px
    )
    edges = transformed(box.reshape(2, 2), crop_from_scene) + 0.5
    in_box = box_coverage(edges.ravel(), size=size_px)
    ends = scene.target.to_scene(bank.ends_px[scene.target.patch].astype(np.float64))
    ends_px = transformed(ends, crop_from_scene).astype(np.float32)
    return TrainingSample(
        image=picture,
        mask=mask,
        in_box=in_box if is_boxed else np.ones_like(in_box),
        ends_px=ends_px if is_boxed and not is_empty else None,
    )


def _visible_box(
    rng: np.random.Generator, bank: PatchBank, scene: TrainingScene, is_part: bool
) -> Float[np.ndarray, "4"] | None:
    """The tight box around the visible part of the target fish; None if that is too little.

    With `is_part` the box of a part of it.
    """
    overview = crop_affine(_OVERVIEW, margin=0.0, size=_OVERVIEW_PX)
    whole = warp_fish(bank, scene.target, overview, size=_OVERVIEW_PX)[..., 3]
    visible = whole * frame_coverage(scene.frame, overview, size=_OVERVIEW_PX)
    for other in scene.before:
        visible = visible * (1 - warp_fish(bank, other, overview, size=_OVERVIEW_PX)[..., 3])
    for occluder in scene.occluders:
        if occluder.hides:
            visible = visible * (1 - draw_into(occluder, overview, size=_OVERVIEW_PX)[0])
    if visible.sum() < _MIN_VISIBLE * whole.sum():
        return None
    x, y, width, height = cv2.boundingRect((visible > 0.5).astype(np.uint8))
    if not width:
        return None
    box = _scene_box(x, y, width, height, overview)
    if not is_part:
        return box
    rows, columns = np.nonzero(visible > 0.5)
    points = (np.column_stack([columns, rows]) - overview[:, 2]) / overview[0, 0]
    return draw_part_box(rng, box, points)


def _empty_box(
    rng: np.random.Generator, bank: PatchBank, scene: TrainingScene
) -> Float[np.ndarray, "4"] | None:
    """A box beside every fish, for 80 % around a part of an occluder; None if none was found."""
    half = rng.uniform(0.1, 0.45, 2)
    center = rng.uniform(-1.0 + half, 1.0 - half)
    window = np.concatenate([center - half, center + half])
    overview = crop_affine(_OVERVIEW, margin=0.0, size=_OVERVIEW_PX)
    part = frame_coverage(window, overview, size=_OVERVIEW_PX)
    part = part * frame_coverage(scene.frame, overview, size=_OVERVIEW_PX)
    layers = (warp_fish(bank, fish, overview, size=_OVERVIEW_PX)[..., 3] for fish in scene.fish)
    if part.sum() < 40 or any((part * layer).sum() > 0.01 * part.sum() for layer in layers):
        return None
    if rng.random() < 0.8:
        things = (
            draw_into(thing, overview, size=_OVERVIEW_PX)[0]
            for thing in [*scene.ground, *scene.occluders]
        )
        part = part * np.maximum.reduce([*things, np.zeros_like(part)])
    x, y, width, height = cv2.boundingRect((part > 0.2).astype(np.uint8))
    if max(width, height) < 8:
        return None
    return _scene_box(x, y, max(width, 2), max(height, 2), overview)


def _scene_box(
    x: int, y: int, width: int, height: int, overview: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "4"]:
    """A box of the overview's pixels in scene units."""
    edges = np.array([x, y, x + width, y + height]) - 0.5
    return (edges - np.tile(overview[:, 2], 2)) / overview[0, 0]
