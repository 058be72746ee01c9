"""Masks from files: one label picture per frame, as in DAVIS 2017.

Pont-Tuset et al., "The 2017 DAVIS Challenge on Video Object Segmentation", arXiv:1704.00675.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Integer
from PIL import Image

from stream_dmr.errors import AnnotationError
from stream_dmr.files import open_file
from stream_dmr.pictures import PICTURE_SUFFIXES

_FILE_NAME = re.compile(r"\d{6,}\.png")
# Pillow's errors for a PNG that it cannot decode; IndexError if it has no pixels.
_DECODING_ERRORS = (
    *(OSError, SyntaxError, ValueError, EOFError, IndexError),
    Image.DecompressionBombError,
)
_MAX_LOOKED_AT = 20  # pictures, in search of ids if the first picture has none
_MIN_GREY_LEVELS = 8  # ids of a picture from which on they are checked for grey levels; chosen
# Commands that make ids of white on black, in place: 1, and 1, 2, 3 ... picture by picture.
_TO_ONE_FISH = (
    ".venv/bin/python -c \"import cv2, sys; [cv2.imwrite(p, (cv2.imread(p, 0) > 127).astype('u1')) "
    'for p in sys.argv[1:]]"'
)
_TO_DIFFERENT_FISH = (
    ".venv/bin/python -c \"import cv2, sys; [cv2.imwrite(p, (cv2.imread(p, 0) > 127).astype('u2') "
    '* n) for n, p in enumerate(sys.argv[1:], 1)]"'
)
_LABEL_MODES = {"1", "L", "P", "I", "I;16", "I;16B"}  # one channel; "P": palette indices


@dataclass(frozen=True, eq=False)
class Labels:
    """The fish id of each pixel of a frame."""

    ids: Integer[np.ndarray, "H W"]  # of a fish; 0: background, or unknown
    unknown: Bool[np.ndarray, "H W"] | None  # hidden by something in front; None: no such pixel

    @cached_property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns with all the fish: a small part of most frames."""
        if self.ids.dtype != np.uint8:
            height, width = self.ids.shape
            return slice(0, height), slice(0, width)
        x, y, width, height = cv2.boundingRect(self.ids)
        return slice(y, y + height), slice(x, x + width)

    @cached_property
    def present(self) -> list[int]:
        """The fish that have a pixel, ascending."""
        ids = self.ids[self.window]
        if ids.dtype == np.uint8 and ids.size:  # counting is ten times as fast as sorting
            counts = cv2.calcHist([ids], [0], None, [256], [0, 256])
            return [int(value) for value in np.flatnonzero(counts) if value > 0]
        return np.unique(ids[ids > 0]).tolist()


class MaskFolder:
    """A folder of label pictures: a pixel's value is a fish's id, 0 is background.

    They are named `000001.png` ... by frame, or like the pictures of a folder: `IMG_7.png` for
    `IMG_7.jpg`, if every picture has a mask of its own name. The largest value of the type, 255 or
    65535, is "unknown": hidden by a gaff, a line or another fish. Pictures are read on demand.
    Values of palette pictures are their indices, not their colours.
    """

    def __init__(
        self, folder: Path, *, pictures: Path | None = None, across_frames: bool = True
    ) -> None:
        """`pictures`: the source of the frames; masks may have the names of a folder's pictures.

        `across_frames`: fish are in several frames; False: each picture stands for itself.
        Raises AnnotationError if the folder is missing or holds no masks for these frames.
        """
        if not folder.is_dir():
            raise AnnotationError(f"{folder}: expected a folder of masks, found none there")
        names = sorted(entry.name for entry in folder.iterdir() if entry.suffix == ".png")
        stems, own = set[str](), {Path(name).stem for name in names}
        if pictures is not None and pictures.is_dir():
            files = (file for file in pictures.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES)
            stems = {file.stem for file in files}
        # Pictures may have numbers as names that are not the numbers of their frames.
        is_named = bool(stems) and stems <= own
        self._is_numbered = not is_named and any(_FILE_NAME.fullmatch(name) for name in names)
        if not self._is_numbered and stems.isdisjoint(own):
            found = f"{names[0]} and the like" if names else "no PNG"
            raise AnnotationError(
                f"{folder}: expected masks named 000001.png, 000002.png ..., or like the pictures "
                f"of the source, found {found}"
            )
        if self._is_numbered and "000000.png" in names:
            raise AnnotationError(
                f"{folder}: expected masks counted from 000001.png, found 000000.png; "
                "rename them by one"
            )
        self.folder = folder
        # Names of its masks, if they are numbered; else of all its pictures.
        self._names = [n for n in names if not self._is_numbered or _FILE_NAME.fullmatch(n)]
        self._has_ids = False
        self._across_frames = across_frames

    def labels(
        self, frame_index: int, *, width: int, height: int, picture: str = ""
    ) -> Labels | None:
        """The labels of a frame of that size in px; None if the folder has none for it.

        `picture`: the frame's file name, by which masks may be named. Raises AnnotationError for a
        label picture in colour, of another size, of grey levels, or unreadable, and if none of them
        has an id.
        """
        stem = f"{frame_index:06d}" if self._is_numbered else Path(picture).stem
        path = self.folder / f"{stem}.png"
        try:
            with open_file(path) as file:
                image = Image.open(file)
                _check_labels(image, path, size=(width, height))
                image.verify()  # the checksums, which decoding leaves out; then it is used up
                file.seek(0)
                # A 1-bit picture is decoded as bool, every other mode as unsigned integers.
                labels = np.asarray(Image.open(file))
        except FileNotFoundError:
            return None
        except _DECODING_ERRORS:
            raise AnnotationError(f"{path}: expected a PNG mask, but it can't be decoded") from None
        if labels.dtype == bool:
            return Labels(labels.astype(np.uint8), None)
        found = self._labels_of(labels)
        if are_grey_levels(found):
            raise AnnotationError(
                f"{path}: expected fish ids, found {len(found.present)} values in thin bands, like "
                f"the grey levels of a soft edge; {self._remedy}"
            )
        return found

    def _labels_of(self, labels: Integer[np.ndarray, "H W"]) -> Labels:
        largest = 255 if labels.dtype == np.uint8 else 65535
        is_unknown = labels == largest
        if not is_unknown.any():
            return Labels(labels, None)
        ids = np.where(is_unknown, 0, labels)
        if not self._has_ids and not ids.any():
            self._check_ids(largest)
        self._has_ids = True
        return Labels(ids, is_unknown)

    def unused(self, last_frame: int) -> list[str]:
        """A line about numbered masks beyond the last frame; masks named like pictures don't count.

        The masks are not opened: a mask without any id counts as well.
        """
        frames = sorted(int(name[:-4]) for name in self._names) if self._is_numbered else []
        beyond = [index for index in frames if index > last_frame]
        if not beyond:
            return []
        which = "all" if len(beyond) == len(frames) else "some"
        return [
            f"masks: {which} are past the end of the source, {len(beyond)} pictures from "
            f"{beyond[0]} on, and it ended at frame {last_frame}; are they of another video?"
        ]

    def _check_ids(self, largest: int) -> None:
        """Raise AnnotationError if fish are drawn as 255 on 0, which is "unknown"."""
        for name in self._names[:: max(1, len(self._names) // _MAX_LOOKED_AT)]:
            try:
                with open_file(self.folder / name) as file, Image.open(file) as picture:
                    values = np.unique(np.asarray(picture))
            except _DECODING_ERRORS:
                continue  # reported when its frame comes
            if ((values > 0) & (values < largest)).any():
                return
        raise AnnotationError(
            f"{self.folder}: expected fish ids from 1 on, found only 0 and {largest}, which means "
            f"unknown; {self._remedy}"
        )

    @property
    def _remedy(self) -> str:
        """Advice on how to write masks of ids from masks of fish pixels."""
        if self._across_frames:
            return (
                "write the mask of a single fish with the value 1: "
                f"{_TO_ONE_FISH} {self.folder}/*.png"
            )
        return (
            "write each picture's fish with a value of its own, since equal ids are one fish: "
            f"{_TO_DIFFERENT_FISH} {self.folder}/*.png"
        )


def are_grey_levels(labels: Labels) -> bool:
    """True if most of many ids have nowhere 3 x 3 pixels of their own, which no fish has.

    Measured: a soft edge has none in 4 of 5 values and more, overlapping fish in 1 of 10 at most.
    """
    if len(labels.present) < _MIN_GREY_LEVELS:
        return False
    ids = labels.ids[labels.window]
    ids = ids if ids.dtype.itemsize <= 2 else ids.astype(np.float32)  # for OpenCV's filters
    block = np.ones((3, 3), np.uint8)
    is_inside = cv2.erode(ids, block) == cv2.dilate(ids, block)
    num_with_inside = len(np.unique(ids[is_inside & (ids > 0)]))
    return num_with_inside < len(labels.present) / 2


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
