"""Training examples from a user's annotated images: each fish is cut out, rotated and relit."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from stream_dmr.errors import AnnotationError
from stream_dmr.segmentation.network.unet_interface import box_coverage
from stream_dmr.segmentation.training.annotated_images import (
    list_images,
    read_annotated_images,
    read_image,
)
from stream_dmr.segmentation.training.box_crops import crop_affine, draw_part_box, jitter_box
from stream_dmr.segmentation.training.fish_patches import PATCH_PX, RIM_PX
from stream_dmr.segmentation.training.image_degradation import add_weather, simulate_camera
from stream_dmr.segmentation.training.random_backgrounds import BACKGROUND_PX
from stream_dmr.segmentation.training.training_sample import TrainingSample

_CUTOUT_PX = 448  # width and height of a cutout: the fish is longer than in a crop
_MARGIN = 0.6  # on each side, of the fish's longer side: room to rotate it
_MIN_AREA_PX = 64  # of a fish's mask, as `[crop_fish] min_mask_area_px`
_PART_SHARE = 0.055  # of the crops, whose box is around a part of the fish
_VALIDATION_EVERY = 5  # images, of which one is kept for validation


Cutout = UInt8[np.ndarray, "C C 4"]  # one fish with its surroundings: BGR, and mask (0 or 255)


def load_fish_cutouts(images: Path, masks: Path) -> tuple[list[Cutout], list[Cutout]]:
    """The fish to train on, and those of every fifth image, for validation.

    Raises AnnotationError where images and masks do not match, or have too few fish.
    """
    training: list[Cutout] = []
    validation: list[Cutout] = []
    for index, annotated in enumerate(read_annotated_images(images, masks)):
        fish = [
            _cut_out(annotated.image, mask)
            for mask in annotated.masks
            if np.count_nonzero(mask) >= _MIN_AREA_PX
        ]
        (validation if index % _VALIDATION_EVERY == _VALIDATION_EVERY - 1 else training).extend(
            fish
        )
    if not training or not validation:
        raise AnnotationError(
            f"{masks}: expected fish of at least {_MIN_AREA_PX} px in at least {_VALIDATION_EVERY} "
            f"images, every fifth of which is for validation, got {len(training)} fish to train on "
            f"and {len(validation)} for validation"
        )
    return training, validation


def draw_annotated_sample(
    rng: np.random.Generator, cutout: Cutout, *, size_px: int
) -> TrainingSample:
    """One crop of a fish, rotated, perhaps mirrored, around a box with random errors."""
    center = (_CUTOUT_PX - 1) / 2
    angle_deg = 90.0 * rng.integers(4) + rng.normal(0.0, 12.0)
    rotation = cv2.getRotationMatrix2D((center, center), angle_deg, 1.0)
    if rng.random() < 0.5:
        rotation = rotation @ np.array([[-1.0, 0.0, 2 * center], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    rows, columns = np.nonzero(cutout[..., 3])
    points = np.column_stack([columns, rows]) @ rotation[:, :2].T + rotation[:, 2]
    box = np.concatenate([points.min(axis=0) - 0.5, points.max(axis=0) + 0.5])
    if rng.random() < _PART_SHARE:
        box = draw_part_box(rng, box, points)
    everywhere = np.array([-np.inf, -np.inf, np.inf, np.inf])
    box = jitter_box(rng, box, limits=everywhere)
    crop_from_rotated = crop_affine(box, margin=rng.uniform(0.08, 0.22), size=size_px)
    crop_from_cutout = crop_from_rotated @ np.vstack([rotation, [0.0, 0.0, 1.0]])
    crop = cv2.warpAffine(cutout, crop_from_cutout, (size_px, size_px), flags=cv2.INTER_LINEAR)
    picture = crop[..., :3].astype(np.float32)
    image = crop[..., :3]
    if rng.random() < 0.7:
        image = simulate_camera(rng, add_weather(rng, picture) if rng.random() < 0.5 else picture)
    edges = box.reshape(2, 2) @ crop_from_rotated[:, :2].T + crop_from_rotated[:, 2] + 0.5
    return TrainingSample(
        image=np.ascontiguousarray(image),
        mask=crop[..., 3].astype(np.float32) / 255,
        in_box=box_coverage(edges.ravel(), size=size_px),
        ends_px=None,
    )


def cutout_patch(cutout: Cutout) -> UInt8[np.ndarray, "P P 4"]:
    """The fish alone, its long axis horizontal, filling a patch: BGR times coverage, coverage."""
    fish = cutout[..., 3] > 0
    rows, columns = np.nonzero(fish)
    points = np.column_stack([columns, rows]).astype(np.float64)
    center = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - center).T))
    turn = np.stack([axes[:, 1], axes[::-1, 1] * [-1, 1]])  # long axis to x, without mirroring
    turned = points @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = (PATCH_PX - 2 * RIM_PX) / max(float((high - low).max()), 1.0)
    affine = np.column_stack([scale * turn, (PATCH_PX - 1) / 2 - scale * (low + high) / 2])
    # The outermost pixels are partly background, so they are left out.
    inner = cv2.erode(fish.astype(np.float32), np.ones((3, 3), np.uint8))
    coverage = cv2.GaussianBlur(inner, (0, 0), 0.6)[..., None]
    layer = np.dstack([cutout[..., :3] * coverage, 255 * coverage])
    patch = cv2.warpAffine(layer, affine, (PATCH_PX, PATCH_PX), flags=cv2.INTER_LINEAR)
    return np.clip(np.round(patch), 0, 255).astype(np.uint8)


def load_backgrounds(folder: Path) -> list[UInt8[np.ndarray, "B B 3"]]:
    """The middle square of every photograph in a folder, at the size of simulated backgrounds."""
    squares = []
    for path in list_images(folder).values():
        image = read_image(path)
        side = min(image.shape[:2])
        top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
        square = image[top : top + side, left : left + side]
        squares.append(cv2.resize(square, (BACKGROUND_PX,) * 2, interpolation=cv2.INTER_AREA))
    return squares


def _cut_out(image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]) -> Cutout:
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    edges = np.array([x, y, x + width, y + height]) - 0.5
    cutout_from_image = crop_affine(edges, margin=_MARGIN, size=_CUTOUT_PX)
    layers = np.dstack([image, mask.astype(np.uint8) * 255])
    shrink = int(1 / cutout_from_image[0, 0])
    if shrink > 1:  # average pixels that would be skipped
        layers = cv2.blur(layers, (shrink, shrink))
    cutout = cv2.warpAffine(
        layers, cutout_from_image, (_CUTOUT_PX, _CUTOUT_PX), flags=cv2.INTER_LINEAR
    )
    cutout[..., 3] = np.where(cutout[..., 3] > 127, 255, 0)
    return cutout
