"""Pictures as compressed bytes and back."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from stream_dmr.errors import RecordingError

_WORD_BYTES, _BLOCK_WORDS = 8, 512
_BLOCK_BYTES = _WORD_BYTES * _BLOCK_WORDS  # part of the file format, see `checksum`

Format = Literal["png", "png1", "jpeg", "reference"]


@dataclass(frozen=True, kw_only=True, slots=True)
class EncodedPicture:
    """A compressed picture; `messages.proto` describes its formats."""

    format: Format
    height: int
    width: int
    data: bytes  # empty for a reference
    crc32: int = 0  # `checksum` of the pixels that the run used; 0: those that `data` decodes to


def compress(
    image: UInt8[np.ndarray, "H W 3"], *, format: Format, jpeg_quality: int = 95
) -> EncodedPicture:
    """A BGR picture as "png" (exact), "jpeg", or "reference" (only its size and checksum)."""
    if format == "reference":
        return _picture(format, image, b"", crc32=checksum(image))
    return _picture(format, image, _encoded(image, format, jpeg_quality))


def _encoded(image: UInt8[np.ndarray, "H W 3"], format: Format, jpeg_quality: int) -> bytes:
    if format == "jpeg":
        parameters = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    else:
        # Level 1: on sensor noise higher levels take many times as long and save 2 %.
        parameters = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return cv2.imencode(f".{format}", image, parameters)[1].tobytes()


def compress_mask(mask: Bool[np.ndarray, "H W"]) -> EncodedPicture:
    """A mask as a PNG of one bit per pixel, exact."""
    grey = mask.astype(np.uint8) * np.uint8(255)
    data = cv2.imencode(".png", grey, [cv2.IMWRITE_PNG_BILEVEL, 1])[1].tobytes()
    return _picture("png1", mask, data)


def color_labels(
    labels: UInt8[np.ndarray, "H W"], palette: Sequence[tuple[int, int, int]]
) -> bytes:
    """A PNG in which label k has the k-th RGB colour of a palette, and label 0 is transparent."""
    picture = Image.fromarray(labels)
    picture.putpalette([0, 0, 0, *chain.from_iterable(palette)])
    file = BytesIO()
    picture.save(file, "png", transparency=0, bits=4, compress_level=1)
    return file.getvalue()


def decompress(picture: EncodedPicture) -> UInt8[np.ndarray, "H W 3"] | Bool[np.ndarray, "H W"]:
    """The pixels: a mask for "png1", BGR otherwise, and of shape (0, 0, 3) for a reference.

    Raises RecordingError for bytes that aren't a picture of the size that was written.
    """
    if picture.format == "reference":
        return np.zeros((0, 0, 3), np.uint8)
    flag = cv2.IMREAD_GRAYSCALE if picture.format == "png1" else cv2.IMREAD_COLOR
    buffer = np.frombuffer(picture.data, np.uint8)
    image = cv2.imdecode(buffer, flag) if len(buffer) else None
    if image is None or image.shape[:2] != (picture.height, picture.width):
        raise RecordingError(
            f"expected a {picture.format} picture of {picture.width} x {picture.height} px in the "
            "recording, found other bytes: the recording is damaged"
        )
    return image > 127 if picture.format == "png1" else image


def checksum(image: UInt8[np.ndarray, "H W 3"]) -> int:
    """A checksum by which a picture of the source is known to be the recorded one.

    CRC-32 of the sums, modulo 2^64, of the BGR bytes in blocks of 512 little-endian 64-bit words,
    the last block filled with zeros. Any single changed byte changes it, and it takes a fifth of
    the time of a CRC-32 over the whole picture.
    """
    data = image.reshape(-1)
    whole = len(data) // _BLOCK_BYTES * _BLOCK_BYTES
    rest = np.zeros(_BLOCK_BYTES, np.uint8)
    rest[: len(data) - whole] = data[whole:]
    blocks = [block.view("<u8").reshape(-1, _BLOCK_WORDS) for block in (data[:whole], rest)]
    sums = np.concatenate([words.sum(axis=1, dtype="<u8") for words in blocks])
    return zlib.crc32(sums.tobytes())


def _picture(format: Format, image: np.ndarray, data: bytes, *, crc32: int = 0) -> EncodedPicture:
    height, width = image.shape[:2]
    return EncodedPicture(format=format, height=height, width=width, data=data, crc32=crc32)
