"""Noise as pictures, and sources read whole, as the tests of sources share them."""

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
