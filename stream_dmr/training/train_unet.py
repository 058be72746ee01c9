"""Train a U-Net, and write its scores and plots."""

import json
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import count, pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8

from stream_dmr.errors import ModelError, OutputError
from stream_dmr.files import make_folder, sha256_of
from stream_dmr.networks.unet import SHIPPED, load_weights
from stream_dmr.segmentation.segmenter import resize
from stream_dmr.training.annotated_images import (
    Cutout,
    cutout_patch,
    draw_annotated_sample,
    load_backgrounds,
    load_fish_cutouts,
)
from stream_dmr.training.image_degradation import PatchBank, load_or_make_bank
from stream_dmr.training.samples import Draw, SampleDataset, TrainingSample, draw_sample
from stream_dmr.training.train_settings import TrainSettings
from stream_dmr.training.unet_trainer import EpochScores, UNetTrainer
from stream_dmr.version import __version__

_NUM_WORST = 32
_PER_ROW = 8
TILE_PX = 192
_WIDTH, _HEIGHT, _EDGE = 720, 400, 48  # px of the curve
_TRUE_BGR, _FOUND_BGR = (80, 220, 80), (60, 60, 255)
_TEXT, _GRID = (60, 60, 60), (225, 225, 225)


def draw_training_curve(history: Sequence[EpochScores], path: Path) -> None:
    """Write scores from 0 to 1 over the epochs, and the loss relative to its highest value."""
    canvas = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    for tenth in range(0, 11, 2):
        left, right = _place(0.0, tenth / 10), _place(1.0, tenth / 10)
        cv2.line(canvas, left, right, _GRID, 1)
        _write(canvas, f"{tenth / 10:.1f}", (8, left[1] + 4), _TEXT)
    highest = max((scores.loss for scores in history if scores.loss is not None), default=1.0)
    losses = [None if s.loss is None else s.loss / highest for s in history]
    curves = {
        "mean IoU": ([s.iou for s in history], (180, 90, 0)),
        "10th percentile of IoU": ([s.iou_p10 for s in history], (220, 170, 90)),
        "heads found at the head": ([s.ends_right for s in history], (60, 140, 30)),
        f"loss / {highest:.2f}": (losses, (90, 90, 200)),
    }
    for index, (name, (values, colour)) in enumerate(curves.items()):
        steps = max(len(values) - 1, 1)
        points = [_place(k / steps, v) for k, v in enumerate(values) if v is not None]
        for start, end in pairwise(points):
            cv2.line(canvas, start, end, colour, 2)
        _write(canvas, name, (_EDGE + 170 * index, 18), colour)
    _write(canvas, f"{history[-1].epoch} epochs", (_WIDTH - 110, _HEIGHT - 12), _TEXT)
    cv2.imwrite(str(path), canvas)


def draw_worst_masks(training: UNetTrainer, validation: SampleDataset, path: Path) -> None:
    """Write the validation pictures of least IoU; green: true outline, red: found outline."""
    ious = training.ious
    worst = np.argsort(ious.numpy())[:_NUM_WORST].tolist()
    samples = {index: validation[index] for index in worst}
    tiles = [
        _tile(sample, training.predict(sample), float(ious[index]))
        for index, sample in samples.items()
    ]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _PER_ROW)
    rows = [np.hstack(tiles[k : k + _PER_ROW]) for k in range(0, len(tiles), _PER_ROW)]
    cv2.imwrite(str(path), np.vstack(rows))


def _tile(
    sample: TrainingSample, found: Bool[np.ndarray, "S S"], iou: float
) -> UInt8[np.ndarray, "T W 3"]:
    """The picture, and below it the same with both outlines."""
    drawn = sample.image.copy()
    for mask, colour in ((sample.mask > 0.5, _TRUE_BGR), (found, _FOUND_BGR)):
        outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(drawn, outlines, -1, colour, 1)
    drawn = resize(drawn, TILE_PX)
    _write(drawn, f"{iou:.2f}", (3, 12), (255, 255, 255))
    return np.vstack([resize(sample.image, TILE_PX), drawn])


def _place(along: float, value: float) -> tuple[int, int]:
    """Pixel of a point of the plot; `along` and `value` from 0 to 1."""
    x = _EDGE + along * (_WIDTH - 2 * _EDGE)
    y = _HEIGHT - _EDGE + 12 - value * (_HEIGHT - 2 * _EDGE)
    return round(x), round(y)


def _write(
    canvas: UInt8[np.ndarray, "H W 3"], text: str, at: tuple[int, int], colour: tuple[int, int, int]
) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)


_VALIDATION_BANK_DIVISOR = 10  # of the training bank's size: the validation bank's

TRAINING_FILES = ("unet.onnx", "unet.pt", "last.pt", "scores.json", "curve.png", "worst.png")


@dataclass(frozen=True, kw_only=True)
class TrainRequest:
    """The options of `stream-dmr train`."""

    out: Path
    settings: TrainSettings
    images: Path | None = None  # the user's, given with `masks`; None: simulated images alone
    masks: Path | None = None
    backgrounds: Path | None = None  # photographs without fish, behind simulated and own fish
    init: Path | None = None  # initial weights; None: shipped weights with `images`, else random
    device: str = "cpu"  # or "cuda"
    resume: bool = False
    command: str = ""  # as typed, for scores.json


class _StoppedError(Exception):
    """`stop` was set while fish and backgrounds were simulated."""


class TrainObserver:
    """Receives the progress of a training; the base class ignores it."""

    def patches_drawn(self, num_done: int, num_all: int) -> None:
        """The bank of simulated fish and backgrounds has `num_done` of `num_all` items."""

    def crops_trained(self, num_crops: int) -> None:
        """Another `num_crops` were trained on."""

    def epoch_done(self, scores: EpochScores, *, is_best: bool) -> None:
        """An epoch was trained and validated."""


def train_unet(
    request: TrainRequest, *, stop: threading.Event, observer: TrainObserver | None = None
) -> EpochScores | None:
    """Train the U-Net; returns the best scores, None if `stop` was set before any.

    Fine-tuning counts its initial weights as epoch 0, so it never ends with worse weights.

    After every epoch `request.out` has the best weights as `unet.onnx`, for runs, and as `unet.pt`,
    to train on from; `last.pt` (to resume from), `scores.json`, `curve.png` and `worst.png`. Raises
    a UserError if an input is wrong, before anything is trained.
    """
    observer = observer or TrainObserver()
    training = _prepare(request)
    try:
        draw, draw_validation = _sources(request, observer, stop)
    except _StoppedError:
        return max(training.history, key=lambda scores: scores.iou, default=None)
    validation = SampleDataset(
        draw_validation,
        size=request.settings.validation_crops,
        batch_size=request.settings.batch_size,
        seed=(request.settings.seed, 0),
    )
    began = time.monotonic()
    if training.is_fine_tuning and not training.history:
        observer.epoch_done(training.check_start(validation), is_best=True)
        _write_report(request, training, validation, elapsed_s=time.monotonic() - began)
    while not training.is_over and not stop.is_set():
        scores = training.run_epoch(draw, validation, stop=stop, progress=observer.crops_trained)
        if scores is None:
            break
        observer.epoch_done(scores, is_best=scores.iou == training.best)
        _write_report(request, training, validation, elapsed_s=time.monotonic() - began)
    return max(training.history, key=lambda scores: scores.iou, default=None)


def _prepare(request: TrainRequest) -> UNetTrainer:
    if request.device == "cuda" and not torch.cuda.is_available():
        raise ModelError(
            "--device cuda: expected a CUDA device, found none that PyTorch can use; "
            "train with --device cpu"
        )
    if (request.out / "last.pt").exists() and not request.resume:
        raise OutputError(
            f"{request.out}: expected a folder without a training, found last.pt of an earlier "
            "one; choose another --out, or add --resume"
        )
    init = request.init or (SHIPPED if request.images is not None else None)
    network = None if init is None else load_weights(init)
    init_sha256 = "" if init is None else sha256_of(init)
    training = UNetTrainer(
        settings=request.settings,
        device=torch.device(request.device),
        out=make_folder(request.out),
        is_fine_tuning=init is not None,
        init_sha256=init_sha256,
    )
    if request.resume:
        training.resume()
        if request.init is not None and init_sha256 != training.init_sha256:
            raise ModelError(
                f"--init {request.init}: expected the weights that this training began with, got "
                "others, which --resume would not use; give those, or another --out"
            )
    else:
        training.begin(network)
    return training


def _sources(
    request: TrainRequest, observer: TrainObserver, stop: threading.Event
) -> tuple[Draw, Draw]:
    """The functions that draw training and validation examples; worker processes unpickle them."""
    if request.images is None or request.masks is None:
        simulated = partial(draw_sample, bank=_bank(request, observer, stop))
        validation_bank = _bank(request, observer, stop, is_validation=True)
        return simulated, partial(draw_sample, bank=validation_bank)
    training, validation = load_fish_cutouts(request.images, request.masks)
    bank = _bank(request, observer, stop).with_photographs(
        [cutout_patch(cutout) for cutout in training],
        load_backgrounds(request.backgrounds) if request.backgrounds is not None else [],
    )
    share = request.settings.own_share
    mixed = partial(_draw_mixed, bank=bank, cutouts=training, own_share=share)
    return mixed, partial(_draw_annotated, cutouts=validation)


def _bank(
    request: TrainRequest,
    observer: TrainObserver,
    stop: threading.Event,
    *,
    is_validation: bool = False,
) -> PatchBank:
    settings = request.settings
    divisor = _VALIDATION_BANK_DIVISOR if is_validation else 1
    num_fish = max(1, settings.bank_fish // divisor)
    num_backgrounds = max(1, settings.bank_backgrounds // divisor)
    done = count(1)

    def progress() -> None:
        if stop.is_set():
            raise _StoppedError
        observer.patches_drawn(next(done), num_fish + num_backgrounds)

    return load_or_make_bank(
        request.out / "cache",
        num_fish=num_fish,
        num_backgrounds=num_backgrounds,
        seed=settings.seed + is_validation,
        progress=progress,
    )


def _draw_annotated(
    rng: np.random.Generator, size_px: int, *, cutouts: Sequence[Cutout]
) -> TrainingSample:
    cutout = cutouts[int(rng.integers(len(cutouts)))]
    return draw_annotated_sample(rng, cutout, size_px=size_px)


def _draw_mixed(
    rng: np.random.Generator,
    size_px: int,
    *,
    bank: PatchBank,
    cutouts: Sequence[Cutout],
    own_share: float,
) -> TrainingSample:
    if rng.random() < own_share:
        return _draw_annotated(rng, size_px, cutouts=cutouts)
    return draw_sample(rng, size_px, bank=bank)


def _write_report(
    request: TrainRequest, training: UNetTrainer, validation: SampleDataset, *, elapsed_s: float
) -> None:
    best = max(training.history, key=lambda scores: scores.iou)
    report = {
        "version": __version__,
        "command": request.command,
        "settings": request.settings.model_dump(),
        "device": request.device,
        "images": None if request.images is None else request.images.name,
        "elapsed_s": round(elapsed_s, 1),  # since the start or the last --resume
        "best": asdict(best),
        "history": [asdict(scores) for scores in training.history],
    }
    (request.out / "scores.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
    draw_training_curve(training.history, request.out / "curve.png")
    if best is training.history[-1]:
        draw_worst_masks(training, validation, request.out / "worst.png")
