"""Noise as pictures, and sources read whole, as the tests of sources share them."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from stream_dmr.errors import SourceError
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings

SETTINGS = ReadFramesSettings()


def noise(seed, *, size=(64, 48), dtype=np.uint8, channels=3):
    """Noise, so that no codec makes a video too small to be cut in the middle."""
    shape = (size[1], size[0], channels) if channels > 1 else (size[1], size[0])
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def read(source):
    opened = open_source(str(source), SETTINGS)
    return opened, list(opened)


def refusal(source):
    with pytest.raises(SourceError) as caught:
        read(source)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def h264(path: Path, *, size=(64, 48), num_frames=10, first_ms=0) -> Path:
    """Noise at 25 frames a second, the first at a time of the container's clock."""
    kind = {".mkv": "matroska", ".ts": "mpegts"}.get(path.suffix)
    with av.open(str(path), "w", format=kind) as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        for seed in range(num_frames):
            frame = av.VideoFrame.from_ndarray(noise(seed, size=size), format="bgr24")
            frame.pts, frame.time_base = first_ms + 40 * seed, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
