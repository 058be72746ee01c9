"""Label pictures are read as Pillow reads them, or left to it."""

import struct
import zlib
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from stream_dmr.segmentation.annotations.label_png import read_label_png

WIDTH, HEIGHT = 7, 5
labels = arrays(np.uint8, (HEIGHT, WIDTH))


def chunk(kind: bytes, content: bytes) -> bytes:
    crc32 = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc32)


def png_of(rows: bytes, *, color: int = 0, interlace: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 8, color, 0, 0, interlace)
    palette = chunk(b"PLTE", bytes(768)) if color == 3 else b""
    packed = zlib.compress(rows)
    parts = [chunk(b"IDAT", packed[:9]), chunk(b"IDAT", packed[9:]), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + palette + b"".join(parts)


def read(data: bytes) -> np.ndarray | None:
    return read_label_png(data, width=WIDTH, height=HEIGHT)


def by_pillow(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(BytesIO(data)))


@given(
    labels, st.lists(st.integers(0, 4), min_size=HEIGHT, max_size=HEIGHT), st.sampled_from([0, 3])
)
def test_every_filter_is_undone_as_pillow_does(filtered, kinds, color):
    rows = b"".join(bytes([k]) + row.tobytes() for k, row in zip(kinds, filtered, strict=True))
    data = png_of(rows, color=color)
    np.testing.assert_array_equal(read(data), by_pillow(data))


@given(labels, st.sampled_from(["L", "P"]))
def test_what_pillow_writes_is_read(picture, mode):
    file = BytesIO()
    Image.fromarray(picture).convert(mode).save(file, "png")
    found = read(file.getvalue())
    if found is not None:  # few colours are written in fewer bits
        np.testing.assert_array_equal(found, by_pillow(file.getvalue()))


@given(labels, st.data())
def test_damaged_pictures_are_left_to_pillow(picture, data):
    rows = b"".join(b"\0" + row.tobytes() for row in picture)
    whole = png_of(rows)
    place = data.draw(st.integers(0, len(whole) - 1))
    damaged = bytearray(whole)
    damaged[place] ^= data.draw(st.integers(1, 255))
    assert read(bytes(damaged)) is None
    assert read(whole[:place]) is None


@pytest.mark.parametrize(
    "rows",
    [
        bytes(HEIGHT * (WIDTH + 1) - 1),
        bytes(HEIGHT * (WIDTH + 1) + 1),
        b"\5" * HEIGHT * (WIDTH + 1),
    ],
    ids=["too few", "too many", "unknown filter"],
)
def test_other_contents_are_left_to_pillow(rows):
    assert read(png_of(rows)) is None


def test_other_pictures_are_left_to_pillow():
    rows = bytes(HEIGHT * (WIDTH + 1))
    assert read(png_of(rows, interlace=1)) is None
    assert read(png_of(rows, color=4)) is None
    assert read_label_png(png_of(rows), width=WIDTH + 1, height=HEIGHT) is None
    assert read(b"GIF89a") is None
