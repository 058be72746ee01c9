"""Epochs and losses of the U-Net."""

import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, log_softmax, max_pool2d
from torch.optim.swa_utils import AveragedModel

from stream_dmr.errors import ModelError, UserError
from stream_dmr.files import replacing
from stream_dmr.networks.unet import UNet, export_unet, normalise, save_weights
from stream_dmr.networks.unet_interface import ENDS_STRIDE
from stream_dmr.training.samples import (
    Batch,
    Draw,
    SampleDataset,
    TrainingSample,
    collate_samples,
    load_batches,
)
from stream_dmr.training.train_settings import TrainSettings

_THIN_SHARE = 0.036  # of the picture's side: wider than a tail seen edge-on
# Added to the weight 1 of every pixel. Without it IoU on the foreign `realistic` scene was 0.918
# instead of 0.930 (docs/research/network-weights.md).
_THIN_WEIGHT = 4.0
_ENDS_SPREAD = 1.0  # standard deviation of the target's blob, cells
_ENDS_WEIGHT = 0.08  # of the ends' loss beside the mask's: chosen by hand: the mask matters more


def mask_loss(logits: Float[Tensor, "B S S"], masks: Float[Tensor, "B S S"]) -> Float[Tensor, ""]:
    """2 x weighted cross entropy, which calibrates probabilities, + 1 - soft IoU, for thin fish.

    soft IoU = (sum p t + 1) / (sum (p + t - p t) + 1) per image. Thin parts weigh more in the cross
    entropy: a tail is few pixels of the mask but a tenth of the length.
    """
    weights = 1 + _THIN_WEIGHT * _thin(masks)
    entropy = binary_cross_entropy_with_logits(logits, masks, weight=weights)
    probability = torch.sigmoid(logits)
    both = (probability * masks).sum(dim=(1, 2))
    either = (probability + masks - probability * masks).sum(dim=(1, 2))
    return 2 * entropy + (1 - (both + 1) / (either + 1)).mean()


def _thin(masks: Float[Tensor, "B S S"]) -> Float[Tensor, "B S S"]:
    """The parts of the masks narrower than `_THIN_SHARE`: mask minus its morphological opening."""
    half = round(_THIN_SHARE * masks.shape[-1] / 2)
    shrunk = -max_pool2d(-masks, 2 * half + 1, stride=1, padding=half)
    return masks - max_pool2d(shrunk, 2 * half + 1, stride=1, padding=half)


def ends_loss(
    logits: Float[Tensor, "B 2 s s"], ends_px: Float[Tensor, "B 2 2"]
) -> Float[Tensor, ""]:
    """Cross entropy over all cells of each end's map, against a Gaussian at the true end.

    Ends outside the image, or NaN, do not count.
    """
    size = logits.shape[-1]
    cells = (ends_px + 0.5) / ENDS_STRIDE - 0.5
    is_inside = ((cells > -0.5) & (cells < size - 0.5)).all(dim=2)
    index = torch.arange(size, device=logits.device)
    distance = index - torch.nan_to_num(cells)[..., None]  # B, 2 ends, x and y, s
    x, y = torch.exp(-0.5 * (distance / _ENDS_SPREAD).square()).unbind(dim=2)
    target = y[..., :, None] * x[..., None, :]
    target = (target / (target.sum(dim=(2, 3), keepdim=True) + 1e-9)).flatten(2)
    entropy = -(target * log_softmax(logits.flatten(2), dim=2)).sum(dim=2)
    return _ENDS_WEIGHT * (entropy * is_inside).sum() / is_inside.sum().clamp(min=1)


def mask_iou(logits: Float[Tensor, "B S S"], masks: Float[Tensor, "B S S"]) -> Float[Tensor, "B"]:
    """Intersection over union of each pair of masks, at probability 0.5; 1 if both are empty."""
    found, true = logits > 0, masks > 0.5
    both, either = (found & true).sum(dim=(1, 2)), (found | true).sum(dim=(1, 2))
    return torch.where(either > 0, both / either.clamp(min=1), 1.0)


def ends_are_right(
    logits: Float[Tensor, "B 2 s s"], ends_px: Float[Tensor, "B 2 2"]
) -> tuple[Bool[Tensor, "B"], Bool[Tensor, "B"]]:
    """Per image: true if the found head is nearer to the true head than to the true tail.

    The second tensor is false if the true ends are unknown.
    """
    size = logits.shape[-1]
    peak = logits[:, 0].flatten(1).argmax(dim=1)
    found = torch.stack([peak % size, peak // size], dim=1) * ENDS_STRIDE + (ENDS_STRIDE - 1) / 2
    to_head, to_tail = (found[:, None] - ends_px).norm(dim=2).unbind(dim=1)
    return to_head < to_tail, ~ends_px.isnan().any(dim=(1, 2))


# Chosen by hand, as usual for networks of this size.
_AVERAGE_DECAY = 0.995  # highest decay per step of the running average of the weights
_WARM_UP = 0.04  # fraction of all steps in which the learning rate rises
_FINE_TUNING_RATE = 0.3  # factor of the learning rate if training starts from weights
_WEIGHT_DECAY = 1e-4
_MAX_GRADIENT_NORM = 5.0


@dataclass(frozen=True, kw_only=True)
class EpochScores:
    """Scores on the validation pictures after an epoch."""

    epoch: int  # from 1; 0: of the weights that fine-tuning began with
    loss: float | None  # mean over the epoch's training pictures; None for epoch 0
    iou: float  # mean over the pictures; the best weights have the highest
    iou_p10: float  # 10th percentile over the pictures
    # Fraction of the fish whose head is found at the head; None if the true ends are unknown.
    ends_right: float | None


@dataclass
class UNetTrainer:
    """A network in training; the checkpoint `last.pt` in the folder `out` holds its whole state."""

    settings: TrainSettings
    device: torch.device
    out: Path
    is_fine_tuning: bool
    init_sha256: str = ""  # of the weights that it began with

    def __post_init__(self) -> None:
        torch.manual_seed(self.settings.seed)
        self.network = UNet()
        self.history: list[EpochScores] = []
        self.ious = torch.empty(0)  # of each validation picture, after the last epoch
        self.best = -math.inf

    def begin(self, network: UNet | None) -> None:
        if network is not None:
            self.network = network
        self.network.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.averaged = AveragedModel(self.network, avg_fn=_average, use_buffers=True)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), weight_decay=_WEIGHT_DECAY)

    def resume(self) -> None:
        """Continue after the last whole epoch. Raises ModelError without a matching checkpoint."""
        self.begin(None)
        path = self.out / "last.pt"
        if not path.exists():
            raise ModelError(f"{path}: expected the checkpoint of an earlier run, found none")
        state: dict[str, Any] = torch.load(path, map_location=self.device, weights_only=True)
        if state["settings"] == self._identity() | {"tuned": not self.is_fine_tuning}:
            had, got = ("none", "one") if self.is_fine_tuning else ("one", "none")
            raise ModelError(
                f"{path}: expected --init or --images if that training had one of them; it had "
                f"{had}, got {got}; give the options of that training, or another --out"
            )
        if state["settings"] != self._identity():
            raise ModelError(
                f"{path}: expected a checkpoint of the same settings, got one of others; give the "
                "config of that run, or another --out"
            )
        self.init_sha256 = state.get("init", self.init_sha256)  # older ones lack it
        self.network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.history = [EpochScores(**scores) for scores in state["history"]]
        self.best = max(scores.iou for scores in self.history)

    @property
    def is_over(self) -> bool:
        """True after all epochs, or after too many without a better IoU."""
        if self._epoch >= self.settings.epochs:
            return True
        ious = [scores.iou for scores in self.history]
        return bool(ious) and len(ious) - 1 - ious.index(max(ious)) >= self.settings.patience

    @property
    def _epoch(self) -> int:
        return self.history[-1].epoch if self.history else 0

    def check_start(self, validation: SampleDataset) -> EpochScores:
        """Score the weights that fine-tuning begins with, so that no worse weights are kept."""
        return self._check_and_keep(validation, epoch=0, loss=None)

    def run_epoch(
        self,
        draw: Draw,
        validation: SampleDataset,
        *,
        stop: threading.Event,
        progress: Callable[[int], None],
    ) -> EpochScores | None:
        """Train for one epoch and validate. None if `stop` was set; then nothing is kept.

        `progress` is called with the number of crops after each step.
        """
        settings, epoch = self.settings, self._epoch + 1
        pictures = SampleDataset(
            draw,
            size=settings.crops_per_epoch,
            batch_size=settings.batch_size,
            seed=(settings.seed, epoch),
        )
        losses = []
        peak = settings.learning_rate * (_FINE_TUNING_RATE if self.is_fine_tuning else 1.0)
        batches = load_batches(pictures, workers=settings.workers)
        for step, batch in enumerate(batches):
            if stop.is_set():
                return None
            part = (epoch - 1 + step / len(batches)) / settings.epochs  # of the training
            rise = min(1.0, (part + 1e-3) / _WARM_UP)  # linear, then a cosine's decay
            for group in self.optimizer.param_groups:
                group["lr"] = peak * rise * 0.5 * (1 + math.cos(math.pi * min(1.0, part)))
            losses.append(self._step(batch))
            progress(len(batch[0]))
        return self._check_and_keep(validation, epoch=epoch, loss=sum(losses) / len(losses))

    def _check_and_keep(
        self, validation: SampleDataset, *, epoch: int, loss: float | None
    ) -> EpochScores:
        self.averaged.eval()
        ious, num_right, num_known = [], 0, 0
        with torch.no_grad():
            for batch in load_batches(validation, workers=0):
                mask_logits, ends_logits, masks, ends_px = self._forward(self.averaged, batch)
                ious.append(mask_iou(mask_logits, masks).cpu())
                is_right, is_known = ends_are_right(ends_logits, ends_px)
                num_right += int((is_right & is_known).sum())
                num_known += int(is_known.sum())
        self.ious = torch.cat(ious)
        scores = EpochScores(
            epoch=epoch,
            loss=loss,
            iou=float(self.ious.mean()),
            iou_p10=float(self.ious.quantile(0.1)),
            ends_right=num_right / num_known if num_known else None,
        )
        self.history.append(scores)
        if scores.iou > self.best:
            self.best = scores.iou
            network = self.averaged.module
            assert isinstance(network, UNet)
            save_weights(network, self.out / "unet.pt")
            export_unet(network, self.out / "unet.onnx")
        state = {
            "settings": self._identity(),
            "init": self.init_sha256,
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "history": [asdict(epoch_scores) for epoch_scores in self.history],
        }
        with replacing(self.out / "last.pt") as draft:  # a crash leaves the previous one
            torch.save(state, draft)
        return scores

    @torch.no_grad()
    def predict(self, sample: TrainingSample) -> Bool[np.ndarray, "S S"]:
        """The mask that the averaged weights find in an example."""
        self.averaged.eval()
        mask_logits, *_ = self._forward(self.averaged, collate_samples([sample]))
        return (mask_logits[0] > 0).cpu().numpy()

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
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRADIENT_NORM)
        self.optimizer.step()
        self.averaged.update_parameters(self.network)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise UserError(
                "expected the training to converge, its loss became infinite; lower [train] "
                "learning_rate or set bfloat16 = false"
            )
        return value

    def _identity(self) -> dict[str, Any]:
        """The settings that a resumed run must share with the one before."""
        return {
            **self.settings.model_dump(exclude={"workers", "patience"}),
            "tuned": self.is_fine_tuning,
        }


def _average(old: Tensor, new: Tensor, num_averaged: Tensor | int) -> Tensor:
    """Exponential average whose decay rises from 0.1, so that the initial weights are forgotten."""
    steps = float(num_averaged)
    keep = min(_AVERAGE_DECAY, (1 + steps) / (10 + steps))
    return torch.lerp(new, old, keep) if old.is_floating_point() else new
