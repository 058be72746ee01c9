"""Pictures for training: each follows from seed, epoch and index alone, so a run can resume."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from stream_dmr.segmentation.training.training_sample import Sample

Draw = Callable[[np.random.Generator], Sample]
Batch = tuple[
    UInt8[Tensor, "B S S 3"],
    Float32[Tensor, "B S S"],
    Float32[Tensor, "B S S"],
    Float32[Tensor, "B 2 2"],
]


class Pictures(Dataset[Sample]):
    """`size` pictures drawn at random; each epoch has new ones, each validation the same."""

    def __init__(self, draw: Draw, *, size: int, seed: tuple[int, ...]) -> None:
        self._draw, self._size, self._seed = draw, size, seed

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, index: int) -> Sample:
        return self._draw(np.random.default_rng((*self._seed, index)))


def load(pictures: Pictures, *, batch_size: int, workers: int) -> DataLoader[Sample]:
    """Batches in order; only whole ones where there are several."""
    return DataLoader(
        pictures,
        batch_size=min(batch_size, len(pictures)),
        num_workers=workers,
        collate_fn=collate,
        drop_last=True,
    )


def collate(samples: list[Sample]) -> Batch:
    """Images, masks, boxes, and ends (NaN: not known) of several samples."""
    nowhere = np.full((2, 2), np.nan, np.float32)
    return (
        torch.from_numpy(np.stack([sample.image for sample in samples])),
        torch.from_numpy(np.stack([sample.mask for sample in samples])),
        torch.from_numpy(np.stack([sample.in_box for sample in samples])),
        torch.from_numpy(
            np.stack([nowhere if sample.ends_px is None else sample.ends_px for sample in samples])
        ),
    )
