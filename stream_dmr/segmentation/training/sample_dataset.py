"""Training examples in batches; each follows from seed, epoch and index alone."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from stream_dmr.segmentation.network.unet_interface import SIZES_PX
from stream_dmr.segmentation.training.training_sample import TrainingSample

Draw = Callable[[np.random.Generator, int], TrainingSample]  # of so many pixels a side
Batch = tuple[
    UInt8[Tensor, "B S S 3"],  # images, BGR
    Float32[Tensor, "B S S"],  # masks
    Float32[Tensor, "B S S"],  # in_box
    Float32[Tensor, "B 2 2"],  # ends in px; NaN: unknown
]


_SMALL_PX, *_LARGER_PX = SIZES_PX
# Every other batch is of the size that videos are cut out at.
_TURNS_PX = tuple(px for larger in _LARGER_PX for px in (_SMALL_PX, larger))


class SampleDataset(Dataset[TrainingSample]):
    """`size` random examples, drawn on demand: equal seeds give equal ones, so a run can resume.

    The pictures of a batch are of one size, in turn those of `_TURNS_PX`.
    """

    def __init__(self, draw: Draw, *, size: int, batch_size: int, seed: tuple[int, ...]) -> None:
        self._draw, self._size, self._seed = draw, size, seed
        self.batch_size = min(batch_size, size)

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, index: int) -> TrainingSample:
        size_px = _TURNS_PX[index // self.batch_size % len(_TURNS_PX)]
        return self._draw(np.random.default_rng((*self._seed, index)), size_px)


def load_batches(samples: SampleDataset, *, workers: int) -> DataLoader[TrainingSample]:
    """Batches in order; an incomplete last one is dropped, unless it is the only one."""
    return DataLoader(
        samples,
        batch_size=samples.batch_size,
        num_workers=workers,
        collate_fn=collate_samples,
        drop_last=True,
    )


def collate_samples(samples: list[TrainingSample]) -> Batch:
    """Several examples as one batch."""
    unknown = np.full((2, 2), np.nan, np.float32)
    return (
        torch.from_numpy(np.stack([sample.image for sample in samples])),
        torch.from_numpy(np.stack([sample.mask for sample in samples])),
        torch.from_numpy(np.stack([sample.in_box for sample in samples])),
        torch.from_numpy(
            np.stack([unknown if sample.ends_px is None else sample.ends_px for sample in samples])
        ),
    )
