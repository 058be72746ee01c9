"""Crops of a first pass are given back as they were, from memory and from the disk."""

from dataclasses import replace

import numpy as np
import pytest

from stream_dmr.messages import FishCrop, TrackEnded
from stream_dmr.pipeline.session import KeptCrops
from stream_dmr.recording.codec import encode
from tests.support.recorded_run import run


@pytest.mark.parametrize("in_memory", [1 << 20, 1000])  # of some 30 kB
def test_gives_back_what_it_took(in_memory):
    messages = list(run(3, num_fish=2))
    crops = [replace(m, image=None) for m in messages if isinstance(m, FishCrop)]
    kept = KeptCrops(in_memory=in_memory)
    for crop in crops:
        kept.keep(crop)
    expected = [encode(crop) for crop in crops]
    assert [encode(crop) for crop in kept] == expected
    assert [encode(crop) for crop in kept] == expected  # as often as they are wanted
    frames = [m for m in messages if type(m).__name__ == "Frame"]
    assert [encode(crop) for frame in frames for crop in kept.step(frame)] == expected
    later = replace(frames[0], frame_index=99, image=np.zeros((2, 2, 3), np.uint8))
    assert list(kept.step(later)) == []
    gone = TrackEnded.after(crops[-1], 1, "lost")
    kept.keep(gone)
    assert kept.step(frames[-1])[-1] is gone
    assert [encode(crop) for crop in kept] == expected
    assert list(kept.close()) == []
