"""Draw a simulated training example.

The order is that of a real crop: a scene, the visible part of its target fish, a box around that
with a detector's errors, and the crop around the box.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from stream_dmr.segmentation.network.unet_interface import box_coverage
from stream_dmr.segmentation.training.background_spots import draw_spot_sample
from stream_dmr.segmentation.training.box_crops import crop_affine, draw_part_box, jitter_box
from stream_dmr.segmentation.training.occluders import draw_into
from stream_dmr.segmentation.training.patch_bank import PatchBank
from stream_dmr.segmentation.training.scene_rendering import (
    frame_coverage,
    render_scene,
    warp_fish,
)
from stream_dmr.segmentation.training.training_sample import TrainingSample
from stream_dmr.segmentation.training.training_scene import SceneFish, TrainingScene, draw_scene

_OVERVIEW_PX = 96  # of a coarse rendering of the scene, in which the boxes are found
_OVERVIEW = np.array([-1.0, -1.0, 1.0, 1.0])  # scene units
_NO_BOX_SHARE = 0.12  # of the examples: no box, the mask is of all fish
_NO_FISH_SHARE = 0.10  # of the examples: the box is around no fish, as detectors' boxes may be
_SPOT_SHARE = 0.45  # of those without a fish: around what stands out in a background
_PART_SHARE = 0.055  # of the examples: the box is around a part of the fish
_MIN_VISIBLE = 0.2  # of the target fish; with less visible the scene is drawn again


def draw_sample(rng: np.random.Generator, bank: PatchBank, *, size_px: int) -> TrainingSample:
    """One crop, `size_px` wide and high, with its true mask and ends."""
    kind = rng.random()
    is_boxed, is_empty = kind >= _NO_BOX_SHARE, kind >= 1 - _NO_FISH_SHARE
    is_part = not is_empty and kind >= 1 - _NO_FISH_SHARE - _PART_SHARE
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
    low, high = box.reshape(2, 2) @ crop_from_scene[:, :2].T + crop_from_scene[:, 2]
    in_box = box_coverage(np.concatenate([low, high]) + 0.5, size=size_px)
    has_ends = is_boxed and not is_empty
    return TrainingSample(
        image=picture,
        mask=mask,
        in_box=in_box if is_boxed else np.ones_like(in_box),
        ends_px=_ends_px(bank, scene.target, crop_from_scene) if has_ends else None,
    )


def _visible_box(
    rng: np.random.Generator, bank: PatchBank, scene: TrainingScene, is_part: bool
) -> Float[np.ndarray, "4"] | None:
    """The tight box around the visible part of the target fish; None where that is too little.

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
        things = (draw_into(one, overview, size=_OVERVIEW_PX)[0] for one in scene.occluders)
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


def _ends_px(
    bank: PatchBank, fish: SceneFish, crop_from_scene: Float[np.ndarray, "2 3"]
) -> Float32[np.ndarray, "2 2"]:
    """Head and tail in the crop, x, y."""
    ends = fish.to_scene(bank.ends_px[fish.patch].astype(np.float64))
    return (ends @ crop_from_scene[:, :2].T + crop_from_scene[:, 2]).astype(np.float32)
