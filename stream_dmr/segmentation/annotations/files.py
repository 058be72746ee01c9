"""Boxes and masks that somebody else made, read from files and refused where they can't be right.

Boxes: MOT Challenge text (Milan et al., "MOT16", arXiv:1603.00831, Table 3).
Masks: one label picture per frame, as in DAVIS 2017 (Pont-Tuset et al., arXiv:1704.00675).
"""

import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Integer
from PIL import Image

from stream_dmr.errors import AnnotationError
from stream_dmr.segmentation.annotations.boxes import UNKNOWN_ID, Box, by_frame, corners
from stream_dmr.segmentation.annotations.coco import load_coco
from stream_dmr.segmentation.annotations.cvat import load_cvat

_COLUMNS = "frame,id,x,y,w,h,conf,class,visibility"
_MASK_NAME = re.compile(r"\d{6,}\.png")
# Pillow's ways to call a PNG broken.
_BROKEN = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)
_LABEL_MODES = {"1", "L", "P", "I", "I;16", "I;16B"}  # one channel; "P": palette indices


def load_boxes(path: Path) -> dict[int, list[Box]]:
    """Boxes by frame (from 1), within a frame by id; an empty file means that there are no fish.

    `.json` is read as COCO, `.xml` as CVAT, everything else as MOT Challenge text. Its columns:
    frame, id, x, y, w, h, conf and optionally class and visibility; with ten columns the last
    three are MOT15's world coordinates. The class is not used; a visibility of -1 means "not
    given", as everywhere in MOT, and so does an id of -1, in all lines or in none.

    Raises AnnotationError with the line's number and what was expected there.
    """
    text = _read_text(path)
    match path.suffix.lower():
        case ".json":
            return load_coco(text, path)
        case ".xml":
            return load_cvat(text, path)
    lines = enumerate(text.splitlines(), start=1)
    return by_frame(
        _parse_box(line, f"{path}, line {number}") for number, line in lines if line.strip()
    )


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise AnnotationError(
            f"{path}: expected a text file of boxes ({_COLUMNS}), got binary data"
        ) from None
    except OSError as error:
        raise AnnotationError(
            f"{path}: expected a file of boxes, but it can't be read: {error.strerror}"
        ) from None


def _parse_box(line: str, where: str) -> tuple[str, int, Box]:
    values = _parse_numbers(line, where)
    frame, track_id, x, y, width, height, confidence = values[:7]
    if frame < 1 or frame != int(frame):
        raise AnnotationError(f"{where}: expected a frame number, counted from 1, got {frame:g}")
    if track_id != -1 and (track_id < 1 or track_id != int(track_id)):
        raise AnnotationError(
            f"{where}: expected an id of 1 or more that follows one fish, "
            f"or -1 in every line for detections, got {track_id:g}"
        )
    bbox = corners(x, y, width, height, where=where)
    visibility = values[8] if len(values) == 9 else -1.0
    if visibility != -1 and not 0 <= visibility <= 1:
        raise AnnotationError(f"{where}: expected a visibility from 0 to 1, got {visibility:g}")
    box = Box(
        track_id=UNKNOWN_ID if track_id == -1 else int(track_id),
        bbox_xyxy_px=bbox,
        visibility=1.0 if visibility == -1 else visibility,
        score=confidence if 0 <= confidence <= 1 else 1.0,
    )
    return where, int(frame), box


def _parse_numbers(line: str, where: str) -> list[float]:
    try:
        values = [float(column) for column in line.split(",")]
    except ValueError:
        values = []
    if not 7 <= len(values) <= 10 or not all(map(math.isfinite, values)):
        raise AnnotationError(
            f"{where}: expected numbers {_COLUMNS}, separated by commas, got {line.strip()[:60]!r}"
        )
    return values


class Masks:
    """A folder of label pictures `000001.png` ...: a pixel's value is its fish's id, 0 is none.

    Pictures are read when asked for. Palette pictures give their indices, not their colours.
    """

    def __init__(self, folder: Path) -> None:
        """Raises AnnotationError where the folder is missing or holds no such pictures."""
        if not folder.is_dir():
            raise AnnotationError(f"{folder}: expected a folder of masks, found none there")
        names = sorted(entry.name for entry in folder.iterdir() if entry.suffix == ".png")
        if not any(_MASK_NAME.fullmatch(name) for name in names):
            found = f"{names[0]} and the like" if names else "no PNG"
            raise AnnotationError(
                f"{folder}: expected masks named 000001.png, 000002.png ..., found {found}"
            )
        if "000000.png" in names:
            raise AnnotationError(
                f"{folder}: expected masks counted from 000001.png, found 000000.png; "
                "rename them by one"
            )
        self.folder = folder

    def labels(
        self, frame_index: int, *, width: int, height: int
    ) -> Integer[np.ndarray, "H W"] | None:
        """The label picture of a frame of that size in px; None where the folder has none.

        Raises AnnotationError for a picture in colour, of another size, or unreadable.
        """
        path = self.folder / f"{frame_index:06d}.png"
        try:
            with Image.open(path) as picture:
                _check_labels(picture, path, size=(width, height))
                # A 1-bit picture comes as bool; every other mode as its own unsigned integers.
                labels = np.asarray(picture)
        except FileNotFoundError:
            return None
        except _BROKEN:
            raise AnnotationError(f"{path}: expected a PNG mask, but it can't be decoded") from None
        return labels.astype(np.uint8) if labels.dtype == bool else labels


def _check_labels(picture: Image.Image, path: Path, *, size: tuple[int, int]) -> None:
    if picture.mode not in _LABEL_MODES:
        raise AnnotationError(
            f"{path}: expected one channel whose pixels are fish ids, got a picture in colour "
            f"({picture.mode}); write the ids as grey values or palette indices"
        )
    if picture.size != size:
        raise AnnotationError(
            f"{path}: expected a mask of the frame's size, {size[0]}x{size[1]} px, "
            f"got {picture.size[0]}x{picture.size[1]} px"
        )
