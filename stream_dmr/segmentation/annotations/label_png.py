"""Reads the PNGs that label pictures mostly are, in half of Pillow's time."""

import struct
import zlib
from collections.abc import Iterator

import numpy as np
from jaxtyping import UInt8

from stream_dmr.compiled import compiled

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY, _PALETTE = 0, 3  # colour types with one number a pixel


def read_label_png(data: bytes, *, width: int, height: int) -> UInt8[np.ndarray, "H W"] | None:
    """The numbers of an 8-bit grey or palette picture of that size, not interlaced.

    None for any other picture, and for a damaged one: Pillow reads it, or says what is wrong.
    """
    try:
        chunks = list(_chunks(data))
        kind, header = chunks[0]
        if kind != b"IHDR" or len(header) != 13:
            return None
        *size, depth, color, _, _, interlace = struct.unpack(">IIBBBBB", header)
        if size != [width, height] or depth != 8 or color not in (_GREY, _PALETTE) or interlace:
            return None
        packed = b"".join(content for kind, content in chunks if kind == b"IDAT")
        inflate, length = zlib.decompressobj(), height * (width + 1)
        rows = inflate.decompress(packed, length + 1)
    except (struct.error, zlib.error, IndexError, ValueError):
        return None
    if len(rows) != length or not inflate.eof:
        return None
    labels = np.empty((height, width), np.uint8)
    return labels if _unfilter(np.frombuffer(rows, np.uint8), labels) else None


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Type and content of each chunk. ValueError for a damaged one, struct.error for a cut one."""
    if not data.startswith(_SIGNATURE):
        raise ValueError("no PNG")
    place, kind = len(_SIGNATURE), b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, place)
        end = place + 8 + length
        (crc32,) = struct.unpack_from(">I", data, end)
        if zlib.crc32(data[place + 4 : end]) != crc32:
            raise ValueError("damaged")
        yield kind, data[place + 8 : end]
        place = end + 4


@compiled
def _unfilter(rows: UInt8[np.ndarray, "N"], labels: UInt8[np.ndarray, "H W"]) -> bool:
    """Undo the filter of each row, PNG specification, section 9; False for one that isn't known."""
    height, width = labels.shape
    for i in range(height):
        first = i * (width + 1) + 1
        kind = int(rows[first - 1])
        if kind > 4:
            return False
        if kind == 1:  # most writers' choice
            left = 0
            for k in range(width):
                left = (left + rows[first + k]) & 255
                labels[i, k] = left
        else:
            _unfilter_row(kind, rows[first : first + width], labels, i)
    return True


@compiled
def _unfilter_row(
    kind: int, row: UInt8[np.ndarray, "W"], labels: UInt8[np.ndarray, "H W"], i: int
) -> None:
    left = corner = 0
    for k in range(len(row)):
        up = int(labels[i - 1, k]) if i > 0 else 0
        guess = 0
        if kind == 2:
            guess = up
        elif kind == 3:
            guess = (left + up) // 2
        elif kind == 4:
            guess = _paeth(left, up, corner)
        left = (int(row[k]) + guess) & 255
        labels[i, k] = left
        corner = up


@compiled
def _paeth(left: int, up: int, corner: int) -> int:
    """That of the three which is nearest to left + up - corner."""
    to_left, to_up = abs(up - corner), abs(left - corner)
    to_corner = abs(left + up - 2 * corner)
    if to_left <= to_up and to_left <= to_corner:
        return left
    return up if to_up <= to_corner else corner
