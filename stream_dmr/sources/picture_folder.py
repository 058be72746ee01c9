"""A folder of pictures as a source of frames."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.pictures import (
    MAX_PIXELS,
    PICTURE_SUFFIXES,
    is_turned,
    pictures_in,
    read_picture,
    size_if_huge,
)
from stream_dmr.sources.source import Source, nominal_ns

OtherSizes = Literal["refuse", "leave_out", "take"]
_DEPTHS = {"uint8", "uint16"}
# What telephones and cameras write and OpenCV does not read.
_UNREADABLE = {".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2"}


class PictureFolder(Source):
    """A folder of pictures in natural order (`2.png` before `10.png`), usually of one size.

    Grey and 16-bit pictures become 8-bit BGR. One that can't be decoded, or is cut off, is left out
    with a warning but keeps its frame index, so that boxes and masks stay with their pictures.
    """

    def __init__(
        self,
        folder: Path,
        *,
        fps: float,
        other_sizes: OtherSizes = "refuse",
        as_sensor: bool = False,
    ) -> None:
        """`other_sizes`: what becomes of pictures whose size is not the first one's.

        Those that are left out are not of the size that most have. `as_sensor`: pictures are not
        turned upright, see `[read_frames] orientation`. Raises SourceError where no picture can be
        decoded.
        """
        self._paths, unreadable = _pictures_in(folder)
        self._is_closed = False
        self._other_sizes = other_sizes
        self.name = folder.resolve().name
        self.num_frames = len(self._paths)
        self.fps = fps
        self.warnings = [] if not unreadable else [_not_read(unreadable)]
        self._as_sensor, self._is_warned = as_sensor, False
        first = next((p for p in map(self._read, self._paths) if p is not None), None)
        if first is None:
            raise SourceError(
                f"{folder}: expected pictures, but none of its {len(self._paths)} can be decoded"
            )
        self.height, self.width = first.shape[:2]
        if other_sizes == "leave_out":  # one picture of another telephone may be the first
            sizes = Counter(p.shape[:2] for p in self._sample()) or {first.shape[:2]: 1}
            self.height, self.width = max(sizes, key=lambda size: sizes[size])
        self._white = self._full_scale() if first.dtype == np.uint16 else 2**16 - 1

    def __iter__(self) -> Iterator[Frame]:
        for frame_index, path in enumerate(self._paths, start=1):
            if self._is_closed:
                return
            picture = self._read(path)
            if picture is None:
                self.warnings.append(
                    f"{path.name}: can't be decoded, or is cut off, so was left out"
                )
                continue
            self._warn_if_turned(path)
            size = picture.shape[1], picture.shape[0]
            if self._other_sizes == "refuse":
                self._require_size(size, path)
            elif self._other_sizes == "leave_out" and size != (self.width, self.height):
                self.warnings.append(
                    f"{path.name}: {size[0]}x{size[1]} px, the calibration is for {self.width}x"
                    f"{self.height}, so was left out; calibrate its camera and run it by itself"
                )
                continue
            yield Frame(
                frame_index=frame_index,
                timestamp_ns=nominal_ns(frame_index, self.fps),
                image=_to_8_bit(picture, self._white),
                source=path.name,
            )

    def _read(self, path: Path) -> np.ndarray | None:
        """As BGR of its own depth; None if it can't be read, or not to its end.

        Raises SourceError for one that is too large, before it takes the memory.
        """
        if huge := size_if_huge(path):
            raise SourceError(
                f"{path}: expected a picture of {MAX_PIXELS // 10**6} megapixels or less, got "
                f"{huge}"
            )
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
        try:
            picture = read_picture(
                path, flags | cv2.IMREAD_IGNORE_ORIENTATION if self._as_sensor else flags
            )
        except OSError:
            return None
        return picture if picture is not None and picture.dtype.name in _DEPTHS else None

    def _full_scale(self) -> int:
        """The value of white in a folder of 16-bit pictures: 4095 or 65535.

        Sensors of 12 bits often write their values unscaled into 16 bits, where they come out all
        but black. A folder is taken for 12 bits where a sample stays below 4096.
        """
        brightest = max((int(p.max()) for p in self._sample()), default=2**16 - 1)
        return 2**12 - 1 if brightest < 2**12 else 2**16 - 1

    def _sample(self) -> Iterator[np.ndarray]:
        """About five pictures, evenly spaced; those that can be read."""
        sample = map(self._read, self._paths[:: max(1, len(self._paths) // 4)])
        return (picture for picture in sample if picture is not None)

    def _warn_if_turned(self, path: Path) -> None:
        if self._as_sensor and not self._is_warned and is_turned(path):
            self._is_warned = True
            self.warnings.append(
                f"pictures such as {path.name} are to be turned by their EXIF; with a calibration "
                "they are measured as the sensor saw them, and masks and boxes must be so"
            )

    def _require_size(self, size: tuple[int, int], path: Path) -> None:
        if size != (self.width, self.height):
            raise SourceError(
                f"{path}: expected {self.width}x{self.height} px, as the first picture has, got "
                f"{size[0]}x{size[1]} px; give --stills where pictures stand for themselves, or "
                'set [read_frames] other_sizes to "leave_out" or "take"'
            )

    def close(self) -> None:
        """End the iteration; no file is held."""
        self._is_closed = True


def _pictures_in(folder: Path) -> tuple[list[Path], list[str]]:
    """Those that can be read, in natural order, and the names of others. SourceError for none."""
    try:
        pictures = pictures_in(folder)
        files = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
    except OSError as error:
        raise SourceError(
            f"{folder}: expected a folder of pictures, but it can't be read: {error.strerror}"
        ) from None
    unreadable = sorted(p.name for p in files if p.suffix.lower() in _UNREADABLE)
    if pictures:
        return pictures, unreadable
    suffixes = ", ".join(sorted(PICTURE_SUFFIXES))
    found = _not_read(unreadable) if unreadable else "found none"
    raise SourceError(f"{folder}: expected a folder of pictures ({suffixes}) or of videos, {found}")


def _not_read(names: list[str]) -> str:
    return f"{len(names)} pictures such as {names[0]} can't be read; save them as JPEG or PNG"


def _to_8_bit(
    picture: UInt8[np.ndarray, "H W 3"] | UInt16[np.ndarray, "H W 3"], full_scale: int
) -> UInt8[np.ndarray, "H W 3"]:
    """Scaled by one factor for the whole folder, so that brightness does not flicker; clipped."""
    if picture.dtype == np.uint8:
        return picture
    return cv2.convertScaleAbs(picture, alpha=255 / full_scale)
