"""Examples follow from seed, epoch and index; batches are whole."""

import numpy as np

from stream_dmr.networks.unet_interface import SIZES_PX
from stream_dmr.training.samples import SampleDataset, TrainingSample, load_batches


def draw(rng: np.random.Generator, size_px: int) -> TrainingSample:
    shape = (size_px, size_px)
    ends = rng.random((2, 2)).astype(np.float32) if rng.random() < 0.5 else None
    return TrainingSample(
        image=rng.integers(0, 256, (*shape, 3), np.uint8),
        mask=rng.random(shape, np.float32),
        in_box=rng.random(shape, np.float32),
        ends_px=ends,
    )


def batches(*, size: int, batch_size: int, epoch: int = 1) -> list[list[np.ndarray]]:
    samples = SampleDataset(draw, size=size, batch_size=batch_size, seed=(4, epoch))
    loaded = load_batches(samples, workers=0)
    return [[part.numpy() for part in batch] for batch in loaded]


def test_each_epoch_is_reproducible_and_new():
    one, again = (batches(size=6, batch_size=3) for _ in range(2))
    for first, second in zip(one, again, strict=True):
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a, b)
    other = batches(size=6, batch_size=3, epoch=2)
    assert (one[0][0] != other[0][0]).any()


def test_an_incomplete_last_batch_is_dropped_unless_it_is_the_only_one():
    assert [len(batch[0]) for batch in batches(size=7, batch_size=3)] == [3, 3]
    assert [len(batch[0]) for batch in batches(size=2, batch_size=3)] == [2]


def test_batches_are_of_every_size_in_turn():
    sides = [batch[0].shape[1:3] for batch in batches(size=9, batch_size=2)]
    assert set(sides) == {(side, side) for side in SIZES_PX}
    assert sides.count((SIZES_PX[0], SIZES_PX[0])) == len(sides) / 2


def test_unknown_ends_are_nan():
    ends = np.concatenate([batch[3] for batch in batches(size=12, batch_size=12)])
    is_unknown = np.isnan(ends).all(axis=(1, 2))
    assert 0 < is_unknown.sum() < 12
    assert not np.isnan(ends[~is_unknown]).any()
