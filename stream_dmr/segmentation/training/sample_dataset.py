"""Training examples in batches; each follows from seed, epoch and index alone."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from stream_dmr.segmentation.training.training_sample import TrainingSample

Draw = Callable[[np.random.Generator], TrainingSample]
Batch = tuple[
    UInt8[Tensor, "B S S 3"],  # images, BGR
    Float32[Tensor, "B S S"],  # masks
    Float32[Tensor, "B S S"],  # in_box
    Float32[Tensor, "B 2 2"],  # ends in px; NaN: unknown
]


class SampleDataset(Dataset[TrainingSample]):
    """`size` random examples, drawn on demand: equal seeds give equal ones, so a run can resume."""

    def __init__(self, draw: Draw, *, size: int, seed: tuple[int, ...]) -> None:
        self._draw, self._size, self._seed = draw, size, seed

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, index: int) -> TrainingSample:
        return self._draw(np.random.default_rng((*self._seed, index)))


def load_batches(
    samples: SampleDataset, *, batch_size: int, workers: int
) -> DataLoader[TrainingSample]:
    """Batches in order; an incomplete last one is dropped, unless it is the only one."""
    return DataLoader(
        samples,
        batch_size=min(batch_size, len(samples)),
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
