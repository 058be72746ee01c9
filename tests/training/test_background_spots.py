"""Spots of backgrounds: boxed tightly, never masked as fish."""

import numpy as np

from stream_dmr.training.image_degradation import make_bank
from stream_dmr.training.samples import draw_spot_sample, find_spot


def test_a_stone_on_plain_ground_is_boxed():
    background = np.full((256, 256, 3), 120, np.uint8)
    background[100:140, 60:120] = (30, 40, 50)
    for seed in range(5):
        box = find_spot(np.random.default_rng(seed), background)
        assert box is not None
        np.testing.assert_allclose(box, [59.5, 99.5, 119.5, 139.5], atol=16)


def test_nothing_stands_out_of_a_plain_background():
    plain = np.full((256, 256, 3), 90, np.uint8)
    assert find_spot(np.random.default_rng(0), plain) is None


def test_a_spot_has_a_box_and_no_fish():
    bank = make_bank(num_fish=1, num_backgrounds=8, seed=3, progress=lambda: None)
    samples = [
        draw_spot_sample(np.random.default_rng(seed), bank, size_px=128) for seed in range(20)
    ]
    found = [sample for sample in samples if sample is not None]
    assert len(found) > 5
    for sample in found:
        assert not sample.mask.any()
        assert 0 < sample.in_box.mean() < 1
        assert sample.ends_px is None
        assert sample.image.shape == (128, 128, 3)
