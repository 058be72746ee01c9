"""Training examples from a user's own pictures, masks, and marks of head and tail."""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Integer, UInt8

from stream_dmr.errors import AnnotationError, reason_of
from stream_dmr.files import read_text
from stream_dmr.geometry import transformed
from stream_dmr.networks.unet_interface import box_coverage
from stream_dmr.pictures import MAX_PIXELS, PICTURE_SUFFIXES, read_picture, size_if_huge
from stream_dmr.segmentation.mask_outlines import decode_coco, require_size
from stream_dmr.training.image_degradation import add_weather, simulate_camera
from stream_dmr.training.random_fish import PATCH_PX, RIM_PX, FishPatch
from stream_dmr.training.samples import (
    PART_SHARE,
    TrainingSample,
    crop_affine,
    draw_part_box,
    jitter_box,
)
from stream_dmr.training.surroundings import BACKGROUND_PX
from stream_dmr.training.training_scene import FADED_SHARE, draw_fade

_MAX_BYTES = 1_000_000_000  # of a COCO file; chosen


@dataclass(frozen=True, eq=False, kw_only=True)
class AnnotatedImage:
    """One image with the masks of its fish."""

    path: Path
    image: UInt8[np.ndarray, "H W 3"]  # BGR
    masks: list[Bool[np.ndarray, "H W"]]
    ends_px: list[Float[np.ndarray, "2 2"]]  # head and tail (x, y) of each fish; NaN: not marked


def read_annotated_images(images: Path, masks: Path) -> Iterator[AnnotatedImage]:
    """The annotated images, ordered by name.

    `masks` is a folder with STEM.png for each image, whose pixel values are fish ids and 0 is
    background, or a COCO file, whose keypoints are head and tail. Beside ids the largest value of
    the type is unknown, as in a run.
    Raises AnnotationError if images and masks do not match.
    """
    paths = list_images(images)
    if masks.is_dir() and masks.samefile(images):
        raise AnnotationError(
            f"{masks}: expected masks in a folder of their own, got that of the images; move them"
        )
    if masks.is_dir():
        yield from _read_folder(paths, masks)
    elif masks.suffix.lower() == ".json":
        yield from _read_coco(paths, masks)
    else:
        raise AnnotationError(f"{masks}: expected a folder of PNG masks or a COCO .json")


def list_images(folder: Path) -> dict[str, Path]:
    """The images of a folder by name, in its order. Raises AnnotationError if it has none."""
    if not folder.is_dir():
        raise AnnotationError(f"{folder}: expected a folder of images, found none there")
    files = sorted(folder.iterdir())
    paths = {path.name: path for path in files if path.suffix.lower() in PICTURE_SUFFIXES}
    if not paths:
        suffixes = ", ".join(sorted(PICTURE_SUFFIXES))
        raise AnnotationError(f"{folder}: expected images ({suffixes}), found none")
    return paths


def _read_folder(paths: dict[str, Path], masks: Path) -> Iterator[AnnotatedImage]:
    missing = [path.name for path in paths.values() if not (masks / f"{path.stem}.png").exists()]
    if missing:
        raise AnnotationError(
            f"{masks}: expected a mask for each of {len(paths)} images, found none for "
            f"{len(missing)}, the first of them {missing[0]}; a mask is named like its image, .png"
        )
    files = {path: masks / f"{path.stem}.png" for path in paths.values()}
    # If 255 is the only value, it is fish; beside ids it is an object that hides them.
    have_ids = any(_ids(labels).any() for labels in map(_read_labels, files.values()))
    for path, mask in files.items():
        image, labels = read_image(path), _read_labels(mask)
        height, width = image.shape[:2]
        if labels.shape != (height, width):
            raise AnnotationError(
                f"{mask}: expected a mask of its image's size, {width}x{height} px, "
                f"got {labels.shape[1]}x{labels.shape[0]} px"
            )
        labels = _ids(labels) if have_ids else labels
        ids = np.unique(labels[labels > 0]).tolist()
        masks_of_it, unmarked = [labels == value for value in ids], [_ends({})] * len(ids)
        yield AnnotatedImage(path=path, image=image, masks=masks_of_it, ends_px=unmarked)


def _read_labels(mask: Path) -> Integer[np.ndarray, "H W"]:
    _refuse_huge(mask)
    labels = _decoded(mask, cv2.IMREAD_UNCHANGED)
    if labels is None or labels.ndim != 2:
        raise AnnotationError(f"{mask}: expected a PNG of one channel, the ids of fish")
    return labels


def _ids(labels: Integer[np.ndarray, "H W"]) -> Integer[np.ndarray, "H W"]:
    """The labels without unknown pixels."""
    return np.where(labels == np.iinfo(labels.dtype).max, 0, labels)


def _read_coco(paths: dict[str, Path], file: Path) -> Iterator[AnnotatedImage]:
    pictures, annotations = _parse_coco(file)
    names = [Path(str(picture["file_name"])).name for picture in pictures]
    for what, values in (("id", [str(p["id"]) for p in pictures]), ("name", names)):
        again = [value for value, count in Counter(values).items() if count > 1]
        if again:
            raise AnnotationError(
                f"{file}: expected images each with a {what} of its own, got {again[0]} more than "
                "once: masks of one would be laid on the other; rename them"
            )
    for picture in pictures:
        name = Path(str(picture["file_name"])).name
        of_it = [fish for fish in annotations if fish.get("image_id") == picture["id"]]
        found = [fish for fish in of_it if not fish.get("iscrowd")]  # several fish as one
        if not found:
            continue
        if name not in paths:
            raise AnnotationError(f"{file}: expected {name} among the images, found it not there")
        image = read_image(paths[name])
        require_size(picture, image.shape[:2], where=f"{file}, image {name}")
        masks = [
            decode_coco(
                image.shape[:2], fish["segmentation"], where=f"{file}, annotation {fish.get('id')}"
            )
            for fish in found
        ]
        ends = [_ends(fish) for fish in found]
        yield AnnotatedImage(path=paths[name], image=image, masks=masks, ends_px=ends)


def _ends(annotation: dict[str, Any]) -> Float[np.ndarray, "2 2"]:
    """Head and tail of COCO's keypoints x, y, v, where v = 0 is "not marked"."""
    try:
        found = np.array(annotation["keypoints"], np.float64).reshape(2, 3)
    except (KeyError, TypeError, ValueError):
        return np.full((2, 2), np.nan)
    return np.where(found[:, 2:] > 0, found[:, :2] - 0.5, np.nan)


def _parse_coco(file: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    try:
        content = json.loads(read_text(file, max_bytes=_MAX_BYTES))
        pictures, annotations = content["images"], content["annotations"]
        pictures = sorted(pictures, key=lambda picture: str(picture["file_name"]))
        if all("id" in p for p in pictures) and all("segmentation" in a for a in annotations):
            return pictures, annotations
    except OSError as error:
        raise AnnotationError(f"{file}: expected a COCO .json, got: {error.strerror}") from None
    except (ValueError, TypeError, KeyError):
        pass
    raise AnnotationError(
        f'{file}: expected COCO\'s JSON with "images" (id, file_name) and "annotations" (image_id, '
        "segmentation)"
    )


def read_image(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """The image, BGR. Raises AnnotationError if it can't be decoded, or is too large for it."""
    _refuse_huge(path)
    image = _decoded(path, cv2.IMREAD_COLOR)
    if image is None:
        raise AnnotationError(f"{path}: expected an image, but it can't be decoded")
    return image


def _decoded(path: Path, flags: int) -> np.ndarray | None:
    try:
        return read_picture(path, flags)
    except OSError as error:
        raise AnnotationError(f"{path}: expected a picture, got: {reason_of(error)}") from None


def _refuse_huge(path: Path) -> None:
    if huge := size_if_huge(path):
        raise AnnotationError(
            f"{path}: expected a picture of {MAX_PIXELS // 10**6} megapixels or less, got {huge}"
        )


_CUTOUT_PX = 448  # width and height of a cutout: the fish is longer than in a crop
_MARGIN = 0.6  # on each side, of the fish's longer side: room to rotate it
_MIN_AREA_PX = 64  # of a fish's mask, as `[crop_fish] min_mask_area_px`
_VALIDATION_EVERY = 5  # every fifth image is kept for validation


class Cutout(NamedTuple):
    """One fish with its surroundings."""

    pixels: UInt8[np.ndarray, "C C 4"]  # BGR, and mask (0 or 255)
    ends_px: Float[np.ndarray, "2 2"]  # head and tail (x, y); NaN: unknown


def load_fish_cutouts(images: Path, masks: Path) -> tuple[list[Cutout], list[Cutout]]:
    """The fish to train on, and the fish of every fifth image, for validation.

    Raises AnnotationError if images and masks do not match, or have too few fish.
    """
    training: list[Cutout] = []
    validation: list[Cutout] = []
    for index, annotated in enumerate(read_annotated_images(images, masks)):
        fish = [
            _cut_out(annotated.image, mask, ends)
            for mask, ends in zip(annotated.masks, annotated.ends_px, strict=True)
            if np.count_nonzero(mask) >= _MIN_AREA_PX
        ]
        is_training = (index + 1) % _VALIDATION_EVERY
        (training if is_training else validation).extend(fish)
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
    rows, columns = np.nonzero(cutout.pixels[..., 3])
    points = transformed(np.column_stack([columns, rows]).astype(np.float64), rotation)
    box = np.concatenate([points.min(axis=0) - 0.5, points.max(axis=0) + 0.5])
    if rng.random() < PART_SHARE:
        box = draw_part_box(rng, box, points)
    everywhere = np.array([-np.inf, -np.inf, np.inf, np.inf])
    box = jitter_box(rng, box, limits=everywhere)
    crop_from_rotated = crop_affine(box, margin=rng.uniform(0.08, 0.22), size=size_px)
    crop_from_cutout = crop_from_rotated @ np.vstack([rotation, [0.0, 0.0, 1.0]])
    crop = cv2.warpAffine(cutout.pixels, crop_from_cutout, (size_px, size_px))
    picture = crop[..., :3].astype(np.float32)
    if is_faded := rng.random() < FADED_SHARE:
        picture = fade_end(rng, picture, crop[..., 3] > 127)
    image = picture.astype(np.uint8)
    if is_faded or rng.random() < 0.7:
        image = simulate_camera(rng, add_weather(rng, picture) if rng.random() < 0.5 else picture)
    edges = transformed(box.reshape(2, 2), crop_from_rotated) + 0.5
    return TrainingSample(
        image=np.ascontiguousarray(image),
        mask=crop[..., 3].astype(np.float32) / 255,
        in_box=box_coverage(edges.ravel(), size=size_px),
        ends_px=transformed(cutout.ends_px, crop_from_cutout).astype(np.float32),
    )


def fade_end(
    rng: np.random.Generator, picture: Float32[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]
) -> Float32[np.ndarray, "S S 3"]:
    """The picture with one end of the fish fading into its surroundings."""
    if np.count_nonzero(mask) < _MIN_AREA_PX:
        return picture
    points, center, axes = _points_and_axes(mask)
    along = (points - center) @ axes[:, 1] * rng.choice([-1.0, 1.0])
    place = (along - along.min()) / max(float(np.ptp(along)), 1.0)
    seen = np.ones(mask.shape, np.float32)
    seen[mask] = draw_fade(rng).seen(place)
    seen = cv2.GaussianBlur(seen, (0, 0), 1.0)[..., None]
    # The surroundings, continued smoothly below the fish, with the grain of another place.
    around = 1 - cv2.dilate(mask.astype(np.float32), np.ones((5, 5), np.uint8))[..., None]
    width = (0, 0), len(picture) / 16
    weight = cv2.GaussianBlur(around, *width)[..., None]
    ground = cv2.GaussianBlur(picture * around, *width) / np.maximum(weight, 1e-3)
    grain = (picture - cv2.GaussianBlur(picture, *width)) * around
    ground += np.roll(grain, tuple(rng.integers(len(picture), size=2)), axis=(0, 1))
    return np.clip(seen * picture + (1 - seen) * ground, 0, 255).astype(np.float32)


def _points_and_axes(
    mask: Bool[np.ndarray, "H W"],
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """The pixels of a mask (x, y), their middle, and its short and long axis as columns."""
    rows, columns = np.nonzero(mask)
    points = np.column_stack([columns, rows]).astype(np.float64)
    center = points.mean(axis=0)
    return points, center, np.linalg.eigh(np.cov((points - center).T))[1]


def cutout_patch(cutout: Cutout) -> FishPatch:
    """The fish alone, its long axis horizontal, filling a patch."""
    fish = cutout.pixels[..., 3] > 0
    points, _, axes = _points_and_axes(fish)
    turn = np.stack([axes[:, 1], axes[::-1, 1] * [-1, 1]])  # long axis to x, without mirroring
    turned = points @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = (PATCH_PX - 2 * RIM_PX) / max(float((high - low).max()), 1.0)
    affine = np.column_stack([scale * turn, (PATCH_PX - 1) / 2 - scale * (low + high) / 2])
    # The outermost pixels are partly background, so they are left out.
    inner = cv2.erode(fish.astype(np.float32), np.ones((3, 3), np.uint8))
    coverage = cv2.GaussianBlur(inner, (0, 0), 0.6)[..., None]
    layer = np.dstack([cutout.pixels[..., :3] * coverage, 255 * coverage])
    patch = cv2.warpAffine(layer, affine, (PATCH_PX, PATCH_PX))
    bgra = np.clip(np.round(patch), 0, 255).astype(np.uint8)
    return FishPatch(bgra=bgra, ends_px=transformed(cutout.ends_px, affine))


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


def _cut_out(
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    ends_px: Float[np.ndarray, "2 2"],
) -> Cutout:
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    edges = np.array([x, y, x + width, y + height]) - 0.5
    cutout_from_image = crop_affine(edges, margin=_MARGIN, size=_CUTOUT_PX)
    layers = np.dstack([image, mask.astype(np.uint8) * 255])
    shrink = int(1 / cutout_from_image[0, 0])
    if shrink > 1:  # average pixels that would be skipped
        layers = cv2.blur(layers, (shrink, shrink))
    cutout = cv2.warpAffine(layers, cutout_from_image, (_CUTOUT_PX, _CUTOUT_PX))
    cutout[..., 3] = np.where(cutout[..., 3] > 127, 255, 0)
    return Cutout(cutout, transformed(ends_px, cutout_from_image))
