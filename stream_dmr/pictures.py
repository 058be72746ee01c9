"""Read pictures from files; recognise files that are no pictures, too large, or cut off."""

import io
import re
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from stream_dmr.files import natural_order, open_file

MAX_PIXELS = 150_000_000  # chosen: the largest cameras have some 100 megapixels
PICTURE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"}

_ORIENTATION = 0x0112  # the tag of EXIF; 1: as it should be shown
_TIFF_STARTS = (b"II", b"MM")
_JPEG_START = b"\xff\xd8"
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")  # not a byte of pixels, nor a restart
_JPEG_END = b"\xd9"


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder as a source has them: frame 1 is the first. Raises OSError."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES)
    return sorted((p for p in files if p.is_file() and p.name[0] != "."), key=natural_order)


def size_if_huge(path: Path) -> str:
    """Width and height of a picture too large to be decoded, by its header; "" of any other file.

    Its pixels alone would take half a gigabyte and more.
    """
    try:
        width, height = stored_size(path)
    except Image.DecompressionBombError:
        return f"more than {MAX_PIXELS // 10**6} megapixels"
    return f"{width}x{height} px" if width * height > MAX_PIXELS else ""


def stored_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture by its header, before any turn; (0, 0) if it has none.

    Raises DecompressionBombError for a picture that Pillow finds too large.
    """
    try:
        with open_file(path) as file, _header(file) as picture:
            return picture.size
    except (OSError, ValueError, SyntaxError):
        return 0, 0


@contextmanager
def _header(file: Path | io.BufferedReader | io.BytesIO) -> Generator[Image.Image]:
    """A picture whose pixels are not read, however many they are."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        with Image.open(file) as picture:
            yield picture


def is_turned(path: Path) -> bool:
    """True for a picture that by its EXIF is not as it should be shown."""
    return _orientation(path) != 1


def _orientation(file: Path | io.BytesIO) -> int:
    """How a picture is to be turned, by its EXIF; 1, not at all, if that can't be read."""
    try:
        with _header(file) as picture:
            return picture.getexif().get(_ORIENTATION, 1)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return 1


def read_picture(path: Path, flags: int) -> np.ndarray | None:
    """A picture by OpenCV's `flags`; None of a file that can't be decoded, or not to its end.

    Raises OSError.
    """
    with open_file(path) as file:
        content = file.read()
    if not content or is_cut_off(content):
        return None
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:  # OpenCV would print a line for each picture of floats or of 32 bits
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if picture is None or not flags & cv2.IMREAD_IGNORE_ORIENTATION:
        return picture
    return _as_stored(picture, content)


def _as_stored(picture: np.ndarray, content: bytes) -> np.ndarray:
    """A decoded picture without the turn that OpenCV gives a TIFF, whatever the flags."""
    if not content.startswith(_TIFF_STARTS):
        return picture
    turn = _orientation(io.BytesIO(content))
    upright = picture.swapaxes(0, 1) if turn in (5, 6, 7, 8) else picture
    down, right = (-1 if turn in turned else 1 for turned in ((3, 4, 6, 7), (2, 3, 7, 8)))
    return np.ascontiguousarray(upright[::down, ::right])


def is_cut_off(content: bytes) -> bool:
    """True for a JPEG that ends before its end marker; OpenCV would fill the rest with grey.

    Its segments are walked, since a thumbnail in a segment has an end marker of its own. OpenCV
    itself refuses pictures of other kinds that are cut off.
    """
    if not content.startswith(_JPEG_START):
        return False
    position = len(_JPEG_START)
    while found := _JPEG_MARKER.search(content, position):
        position = found.end()
        if found[0][-1:] == _JPEG_END:
            return False
        position += int.from_bytes(content[position : position + 2])  # the segment's length
    return True
