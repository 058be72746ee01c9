"""A user's images with the masks of their fish: label pictures, or COCO's JSON."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Integer, UInt8

from stream_dmr.errors import AnnotationError
from stream_dmr.pictures import MAX_PIXELS, PICTURE_SUFFIXES, size_if_huge


@dataclass(frozen=True, eq=False, kw_only=True)
class AnnotatedImage:
    """One image with the masks of its fish."""

    path: Path
    image: UInt8[np.ndarray, "H W 3"]  # BGR
    masks: list[Bool[np.ndarray, "H W"]]


def read_annotated_images(images: Path, masks: Path) -> Iterator[AnnotatedImage]:
    """The annotated images, ordered by name.

    `masks` is a folder with STEM.png for each image, whose pixel values are fish ids and 0 is
    background, or a COCO file. Beside ids the largest value of the type is unknown, as in a run.
    Raises AnnotationError where images and masks do not match.
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
    """The images of a folder by name, in its order. Raises AnnotationError where it has none."""
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
    # Fish that are drawn as 255 alone are fish; beside ids that is what hides them.
    have_ids = any(_ids(labels).any() for labels in map(_read_labels, files.values()))
    for path, mask in files.items():
        image, labels = read_image(path), _read_labels(mask)
        _check_size(mask, labels.shape, image)
        labels = _ids(labels) if have_ids else labels
        ids = np.unique(labels[labels > 0]).tolist()
        yield AnnotatedImage(path=path, image=image, masks=[labels == one for one in ids])


def _read_labels(mask: Path) -> Integer[np.ndarray, "H W"]:
    _refuse_huge(mask)
    labels = cv2.imread(str(mask), cv2.IMREAD_UNCHANGED)
    if labels is None or labels.ndim != 2:
        raise AnnotationError(f"{mask}: expected a PNG of one channel, the ids of fish")
    return labels


def _ids(labels: Integer[np.ndarray, "H W"]) -> Integer[np.ndarray, "H W"]:
    """Without what is unknown."""
    return np.where(labels == np.iinfo(labels.dtype).max, 0, labels)


def _read_coco(paths: dict[str, Path], file: Path) -> Iterator[AnnotatedImage]:
    pictures, annotations = _parse_coco(file)
    for picture in pictures:
        name = Path(str(picture["file_name"])).name
        of_it = [one for one in annotations if one.get("image_id") == picture["id"]]
        found = [one for one in of_it if not one.get("iscrowd")]  # several fish as one
        if not found:
            continue
        if name not in paths:
            raise AnnotationError(f"{file}: expected {name} among the images, found it not there")
        image = read_image(paths[name])
        masks = [_decode(one, file, image.shape[:2]) for one in found]
        yield AnnotatedImage(path=paths[name], image=image, masks=masks)


def _parse_coco(file: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        pictures, annotations = content["images"], content["annotations"]
        pictures = sorted(pictures, key=lambda one: str(one["file_name"]))
        if all("id" in one for one in pictures) and all("segmentation" in a for a in annotations):
            return pictures, annotations
    except OSError as error:
        raise AnnotationError(f"{file}: expected a COCO .json, got: {error.strerror}") from None
    except (ValueError, TypeError, KeyError):
        pass
    raise AnnotationError(
        f'{file}: expected COCO\'s JSON with "images" (id, file_name) and "annotations" (image_id, '
        "segmentation)"
    )


def _decode(
    annotation: dict[str, Any], file: Path, shape: tuple[int, ...]
) -> Bool[np.ndarray, "H W"]:
    """A mask from polygons (x, y, ... from the image's corner) or from run lengths.

    COCO's runs go down the columns and begin with background.
    """
    segmentation = annotation["segmentation"]
    try:
        if isinstance(segmentation, dict):
            counts = segmentation["counts"]
            runs = _unpack(counts) if isinstance(counts, str) else counts
            if sum(runs) != shape[0] * shape[1] or list(segmentation["size"]) != list(shape):
                raise AnnotationError(
                    f"{file}: expected a mask of {shape[1]}x{shape[0]} px, got one of another size "
                    f"(annotation {annotation.get('id')})"
                )
            values = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
            return np.ascontiguousarray(values.reshape(shape[1], shape[0]).T)
        canvas = np.zeros(shape, np.uint8)
        corners = [np.array(ring, np.float64).reshape(-1, 2) - 0.5 for ring in segmentation]
        cv2.fillPoly(canvas, [np.round(ring * 16).astype(np.int32) for ring in corners], 1, shift=4)
        return canvas > 0
    except (ValueError, TypeError, KeyError):
        raise AnnotationError(
            f"{file}: expected polygons or run lengths, got something else "
            f"(annotation {annotation.get('id')})"
        ) from None


def _unpack(text: str) -> list[int]:
    """COCO's compressed run lengths: 5 bits a character, differences to the last run but one.

    After `rleFrString` of the COCO API (github.com/cocodataset/cocoapi, common/maskApi.c).
    """
    runs: list[int] = []
    value = shift = 0
    for byte in text.encode("ascii"):
        bits = byte - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    return runs


def read_image(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """The image, BGR. Raises AnnotationError where it can't be decoded, or is too large for it."""
    _refuse_huge(path)
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise AnnotationError(f"{path}: expected an image, but it can't be decoded")
    return image


def _refuse_huge(path: Path) -> None:
    if huge := size_if_huge(path):
        raise AnnotationError(
            f"{path}: expected a picture of {MAX_PIXELS // 10**6} megapixels or less, got {huge}"
        )


def _check_size(mask: Path, shape: tuple[int, ...], image: UInt8[np.ndarray, "H W 3"]) -> None:
    height, width = image.shape[:2]
    if shape != (height, width):
        raise AnnotationError(
            f"{mask}: expected a mask of its image's size, {width}x{height} px, "
            f"got {shape[1]}x{shape[0]} px"
        )
