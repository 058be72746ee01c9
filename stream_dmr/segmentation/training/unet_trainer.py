"""Teaching the U-Net: epochs, checks on pictures it never learns, checkpoints, the best weights."""

import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from stream_dmr.errors import ModelError, UserError
from stream_dmr.segmentation.network.unet import UNet, normalise
from stream_dmr.segmentation.network.unet_weights import save_weights
from stream_dmr.segmentation.training.sample_dataset import Batch, Draw, Pictures, collate, load
from stream_dmr.segmentation.training.train_settings import TrainSettings
from stream_dmr.segmentation.training.training_sample import Sample
from stream_dmr.segmentation.training.unet_losses import (
    ends_are_right,
    ends_loss,
    mask_iou,
    mask_loss,
)

_AVERAGE = 0.995  # most of the running average of the weights that a step leaves as it was
_WARM_UP = 0.04  # of all steps
_FINE_TUNING = 0.3  # of the learning rate, where training starts from weights


@dataclass(frozen=True, kw_only=True)
class Scores:
    """How well the network does on the validation pictures after an epoch."""

    epoch: int  # 0: of the weights that fine-tuning began with
    loss: float | None  # of the training pictures, mean over the epoch; None for epoch 0
    iou: float  # mean over the pictures
    iou_p10: float  # one picture in ten is below
    # Share of the fish whose head is found at the head; None where nobody said where it is.
    ends_right: float | None

    @property
    def merit(self) -> float:
        """What the best weights are chosen by."""
        return self.iou


@dataclass
class Training:
    """A network being taught; `last.pt` in the folder holds all of it."""

    settings: TrainSettings
    device: torch.device
    out: Path
    is_fine_tuning: bool

    def __post_init__(self) -> None:
        torch.manual_seed(self.settings.seed)
        self.network = UNet()
        self.history: list[Scores] = []
        self.ious = torch.empty(0)  # of each validation picture, after the last epoch
        self.best = -math.inf

    def begin(self, network: UNet | None) -> None:
        """Start from these weights, or from random ones."""
        if network is not None:
            self.network = network
        self.network.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.averaged = AveragedModel(self.network, avg_fn=_average, use_buffers=True)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), weight_decay=1e-4)

    def resume(self) -> None:
        """Go on after the last whole epoch. Raises ModelError where that can't be."""
        self.begin(None)
        path = self.out / "last.pt"
        if not path.exists():
            raise ModelError(f"{path}: expected the checkpoint of an earlier run, found none")
        state: dict[str, Any] = torch.load(path, map_location=self.device, weights_only=True)
        if state["settings"] != self._identity():
            raise ModelError(
                f"{path}: expected a checkpoint of the same settings, got one of others; give the "
                "config of that run, or another --out"
            )
        self.network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.history = [Scores(**scores) for scores in state["history"]]
        self.best = max(scores.merit for scores in self.history)

    @property
    def is_over(self) -> bool:
        """Whether all epochs have gone by, or too many without anything better."""
        if self._epoch >= self.settings.epochs:
            return True
        merits = [scores.merit for scores in self.history]
        return (
            bool(merits) and len(merits) - 1 - merits.index(max(merits)) >= self.settings.patience
        )

    @property
    def _epoch(self) -> int:
        """The last one."""
        return self.history[-1].epoch if self.history else 0

    def check_start(self, validation: Pictures) -> Scores:
        """Score the weights that fine-tuning begins with: none that are worse are kept."""
        return self._check_and_keep(validation, epoch=0, loss=None)

    def run_epoch(
        self,
        draw: Draw,
        validation: Pictures,
        *,
        stop: threading.Event,
        progress: Callable[[int], None],
    ) -> Scores | None:
        """Teach for one epoch and check; None where `stop` broke in, and then nothing is kept."""
        settings, epoch = self.settings, self._epoch + 1
        pictures = Pictures(draw, size=settings.crops_per_epoch, seed=(settings.seed, epoch))
        losses = []
        batches = load(pictures, batch_size=settings.batch_size, workers=settings.workers)
        for step, batch in enumerate(batches):
            if stop.is_set():
                return None
            self._set_rate((epoch - 1 + step / len(batches)) / settings.epochs)
            losses.append(self._step(batch))
            progress(len(batch[0]))
        return self._check_and_keep(validation, epoch=epoch, loss=sum(losses) / len(losses))

    def _check_and_keep(self, validation: Pictures, *, epoch: int, loss: float | None) -> Scores:
        self.ious, right = self.check(validation)
        scores = Scores(
            epoch=epoch,
            loss=loss,
            iou=float(self.ious.mean()),
            iou_p10=float(self.ious.quantile(0.1)),
            ends_right=right,
        )
        self._keep(scores)
        return scores

    @torch.no_grad()
    def check(self, validation: Pictures) -> tuple[Tensor, float | None]:
        """IoU of each validation picture, and the share of heads found at the head."""
        self.averaged.eval()
        ious, right, asked = [], 0, 0
        for batch in load(validation, batch_size=self.settings.batch_size, workers=0):
            mask_logits, ends_logits, masks, ends_px = self._forward(self.averaged, batch)
            ious.append(mask_iou(mask_logits, masks).cpu())
            is_right, is_asked = ends_are_right(ends_logits, ends_px)
            right, asked = right + int((is_right & is_asked).sum()), asked + int(is_asked.sum())
        return torch.cat(ious), right / asked if asked else None

    @torch.no_grad()
    def predict(self, samples: list[Sample]) -> Bool[np.ndarray, "B S S"]:
        """The masks that the averaged weights find."""
        self.averaged.eval()
        mask_logits, *_ = self._forward(self.averaged, collate(samples))
        return (mask_logits > 0).cpu().numpy()

    def _forward(self, network: torch.nn.Module, batch: Batch) -> Iterator[Tensor]:
        images, masks, in_box, ends_px = (part.to(self.device) for part in batch)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bfloat16):
            mask_logits, ends_logits = network(normalise(images.float(), in_box))
        yield from (mask_logits.float(), ends_logits.float(), masks, ends_px)

    def _step(self, batch: Batch) -> float:
        self.network.train()
        mask_logits, ends_logits, masks, ends_px = self._forward(self.network, batch)
        loss = mask_loss(mask_logits, masks) + ends_loss(ends_logits, ends_px)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self.optimizer.step()
        self.averaged.update_parameters(self.network)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise UserError(
                "expected the training to converge, its loss became infinite; lower [train] "
                "learning_rate or set bfloat16 = false"
            )
        return value

    def _set_rate(self, part: float) -> None:
        """Up in a straight line, then down along a cosine; `part` of the training is done."""
        peak = self.settings.learning_rate * (_FINE_TUNING if self.is_fine_tuning else 1.0)
        rise = min(1.0, (part + 1e-3) / _WARM_UP)
        for group in self.optimizer.param_groups:
            group["lr"] = peak * rise * 0.5 * (1 + math.cos(math.pi * min(1.0, part)))

    def _keep(self, scores: Scores) -> None:
        self.history.append(scores)
        if scores.merit > self.best:
            self.best = scores.merit
            network = self.averaged.module
            assert isinstance(network, UNet)
            save_weights(network, self.out / "unet.pt")
        state = {
            "settings": self._identity(),
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "history": [asdict(scores) for scores in self.history],
        }
        unfinished = self.out / "last.pt.part"
        torch.save(state, unfinished)
        unfinished.replace(self.out / "last.pt")  # a crash leaves the one before

    def _identity(self) -> dict[str, Any]:
        """What a resumed run must share with the one before."""
        return {
            **self.settings.model_dump(exclude={"workers", "patience"}),
            "tuned": self.is_fine_tuning,
        }


def _average(old: Tensor, new: Tensor, num_averaged: Tensor | int) -> Tensor:
    """Nearly the plain mean of the first steps, later an exponential one: no start lingers on."""
    steps = float(num_averaged)
    keep = min(_AVERAGE, (1 + steps) / (10 + steps))
    return torch.lerp(new, old, keep) if old.is_floating_point() else new
