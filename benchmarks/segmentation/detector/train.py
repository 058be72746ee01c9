"""Train the detector that ships, from what COCO taught YOLOX-nano.

    python -m benchmarks.segmentation.detector.train CLONES DATA yolox_nano.onnx --out fish.onnx

CLONES and DATA as for `real_images`, which builds DATA. `yolox_nano.onnx` is the file of YOLOX's
release 0.1.1rc0 (Apache-2.0, Megvii), learnt on the 118,000 photographs of COCO; many repositories
bring it along. After each of ten parts of the training: how many fish of the pictures that are
held back are found, and how many of the boxes found are fish, at the score where both are equal.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_avg_fn
from torch.utils.data import DataLoader, IterableDataset

from benchmarks.segmentation.detector.export import OUTPUTS, export_detector, go_on_from
from benchmarks.segmentation.detector.frame_sources import read_sources
from benchmarks.segmentation.detector.loss import detection_loss
from benchmarks.segmentation.detector.onnx_module import OnnxModule
from benchmarks.segmentation.detector.scores import score
from benchmarks.segmentation.detector.training_frames import FrameSource, read_singles
from stream_dmr.training.annotated_images import cutout_patch, load_backgrounds, load_fish_cutouts
from stream_dmr.training.image_degradation import load_or_make_bank

_SINGLES = ["fish_market", "caltech_bass", "milkfish_weight", "specimens", "fishial"]
_BATCH, _WEIGHT_DECAY = 16, 1e-4
_DECAY = 0.995  # of the running average that is kept
_PARTS = 10

Batch = tuple[Float32[Tensor, "B 3 S S"], list[Float32[Tensor, "T 4"]]]


class _Drawn(IterableDataset[Batch]):
    """Batches without end, which follow from the seed."""

    def __init__(self, source: FrameSource, seed: int) -> None:
        self._source, self._seed = source, seed

    def __iter__(self) -> Iterator[Batch]:
        rng = np.random.default_rng(self._seed)
        while True:
            drawn = [self._source(rng) for _ in range(_BATCH)]
            pictures = np.stack([picture for picture, _ in drawn]).transpose(0, 3, 1, 2)
            boxes = [torch.from_numpy(found).float() for _, found in drawn]
            yield torch.from_numpy(pictures.astype(np.float32)), boxes


def train(
    source: FrameSource, network: OnnxModule, *, steps: int, seed: int, highest_rate: float
) -> Iterator[OnnxModule]:
    """The averaged network after each part of the training."""
    torch.manual_seed(seed)
    averaged = AveragedModel(network, avg_fn=get_ema_avg_fn(_DECAY))
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=_WEIGHT_DECAY)
    batches = iter(DataLoader(_Drawn(source, seed), batch_size=None, num_workers=1))
    losses = []
    for step in range(steps):
        rate = min(1.0, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * step / steps))
        for group in optimizer.param_groups:
            group["lr"] = highest_rate * rate
        pictures, boxes = next(batches)
        with torch.autocast("cpu", torch.bfloat16):
            outputs = network(pictures.contiguous(memory_format=torch.channels_last))
        loss = detection_loss([output.float() for output in outputs], boxes)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        averaged.update_parameters(network)
        losses.append(float(loss.detach()))
        if (step + 1) % (steps // _PARTS) == 0:
            print(f"step {step + 1}: loss {np.mean(losses):.3f}", flush=True)
            losses = []
            kept = averaged.module
            assert isinstance(kept, OnnxModule)
            yield kept


def main() -> None:
    """Read the sources, train, score and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("repositories", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("yolox", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--init", type=Path, help="a file of this command, to go on from")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, default=1e-3, help="highest step size")
    arguments = parser.parse_args()
    learnt, held_back = read_sources(arguments.repositories)
    for name, frames in learnt.items():
        print(f"{name}: {len(frames)} frames, {len(held_back[name])} held back", flush=True)
    folder = arguments.data / "train"
    source = FrameSource(
        frames=[frames for frames in learnt.values() if frames],
        singles=read_singles(folder / "images", folder / "masks", sources=_SINGLES),
        bank=load_or_make_bank(
            arguments.out.parent / "cache",
            num_fish=3000,
            num_backgrounds=1000,
            seed=arguments.seed,
            progress=lambda: None,
        ).with_photographs(
            [
                cutout_patch(one)
                for one in load_fish_cutouts(folder / "images", folder / "masks")[0]
            ],
            load_backgrounds(arguments.data / "backgrounds"),
        ),
    )
    print(f"{len(source.singles)} single fish", flush=True)
    network = OnnxModule(arguments.yolox, OUTPUTS)
    if arguments.init is not None:
        go_on_from(network, arguments.init)
    training = train(
        source,
        network,
        steps=arguments.steps,
        seed=arguments.seed,
        highest_rate=arguments.rate,
    )
    for averaged in training:
        export_detector(averaged, arguments.out)
        for name, pictures in held_back.items():
            print(f"  {name}: {score(arguments.out, pictures).summary}", flush=True)


if __name__ == "__main__":
    main()
