"""Simulated examples: reproducible, with boxes and ends that fit their fish."""

import cv2
import numpy as np
import pytest

from stream_dmr.training.image_degradation import PatchBank, make_bank
from stream_dmr.training.samples import TrainingSample, draw_sample


@pytest.fixture(scope="module")
def bank() -> PatchBank:
    return make_bank(num_fish=12, num_backgrounds=4, seed=5, progress=lambda: None)


@pytest.fixture(scope="module")
def samples(bank: PatchBank) -> list[TrainingSample]:
    seeds = ((1, seed) for seed in range(150))
    return [draw_sample(np.random.default_rng(seed), size_px=128, bank=bank) for seed in seeds]


def assert_equal(one: TrainingSample, other: TrainingSample):
    for name in ("image", "mask", "in_box", "ends_px"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_equal_seeds_give_equal_pictures(bank):
    for seed in range(8):
        one, other = (
            draw_sample(np.random.default_rng(seed), size_px=192, bank=bank) for _ in range(2)
        )
        assert_equal(one, other)
    again = make_bank(num_fish=12, num_backgrounds=4, seed=5, progress=lambda: None)
    np.testing.assert_array_equal(again.fish, bank.fish)


def test_boxes_fit_their_fish(samples):
    shares, extents = [], []
    for sample in samples:
        assert 0 <= sample.mask.min() <= sample.mask.max() <= 1 + 1e-6
        if sample.in_box.min() == 1 or sample.mask.sum() < 50:
            continue  # no box is given, or next to nothing is seen
        fish, box = sample.mask > 0.5, sample.in_box > 0.5
        shares.append((fish & box).sum() / fish.sum())
        inner, outer = (cv2.boundingRect(part.astype(np.uint8))[2:] for part in (fish & box, box))
        extents.append(max(a / b for a, b in zip(inner, outer, strict=True)))
    assert np.median(shares) > 0.98
    assert np.median(extents) > 0.94
    assert len(shares) > 100


def test_heads_and_tails_lie_at_the_ends_of_their_fish(samples):
    distances = []
    for sample in samples:
        if sample.ends_px is None:
            assert sample.in_box.min() == 1 or not sample.mask.any()  # no box, or no fish in it
            continue
        rows, columns = np.nonzero(sample.mask > 0.5)
        fish = np.column_stack([columns, rows])
        inside = ((sample.ends_px > 2) & (sample.ends_px < 125)).all(axis=1)
        for end in sample.ends_px[inside]:
            distances.append(np.linalg.norm(fish - end, axis=1).min())
    assert np.quantile(distances, 0.7) < 3.0  # others are hidden
