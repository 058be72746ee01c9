"""`stream-dmr train`: from what the user asks for to weights, scores and pictures in a folder."""

import json
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from stream_dmr.errors import ModelError, OutputError
from stream_dmr.segmentation.network.unet_weights import SHIPPED, load_weights
from stream_dmr.segmentation.training.annotated_samples import Cut, draw_own, load_own_fish
from stream_dmr.segmentation.training.patch_bank import Bank, load_or_make_bank
from stream_dmr.segmentation.training.sample_dataset import Draw, Pictures
from stream_dmr.segmentation.training.scene_composition import draw_sample
from stream_dmr.segmentation.training.train_settings import TrainSettings
from stream_dmr.segmentation.training.training_plots import draw_curve, draw_worst
from stream_dmr.segmentation.training.training_sample import Sample
from stream_dmr.segmentation.training.unet_trainer import Scores, Training
from stream_dmr.version import __version__

_UNSEEN = 10  # times smaller than the bank to learn from is the one to check on


@dataclass(frozen=True, kw_only=True)
class TrainRequest:
    """What the user asks for."""

    out: Path
    settings: TrainSettings
    images: Path | None = None  # of the user's vessel, with `masks`; None: simulated ones alone
    masks: Path | None = None
    init: Path | None = (
        None  # weights to start from; None: the shipped ones for `images`, else none
    )
    device: str = "cpu"
    resume: bool = False
    command: str = ""  # as typed, for the scores


class TrainObserver:
    """Is told how the training goes; this one shows nothing."""

    def drawing(self, num_done: int, num_all: int) -> None:
        """So many parts of simulated pictures are drawn."""

    def learning(self, num_crops: int) -> None:
        """So many crops more were learnt from."""

    def checked(self, scores: Scores, *, is_best: bool) -> None:
        """An epoch is over."""


def train(
    request: TrainRequest, *, stop: threading.Event, observer: TrainObserver | None = None
) -> Scores | None:
    """Teach the U-Net; returns the best scores, None where `stop` came before any.

    Fine-tuning counts the weights that it begins with as epoch 0: it never ends with worse ones.

    Writes `unet.pt` (the best weights), `last.pt` (to resume from), `scores.json`, `curve.png` and
    `worst.png` into `request.out`, after every epoch. Raises a UserError where an input is wrong,
    before anything is learnt.
    """
    observer = observer or TrainObserver()
    training = _prepare(request)
    draw, check = _sources(request, observer)
    validation = Pictures(
        check, size=request.settings.validation_crops, seed=(request.settings.seed, 0)
    )
    began = time.monotonic()
    if training.is_fine_tuning and not training.history:
        observer.checked(training.check_start(validation), is_best=True)
        _write_report(request, training, validation, elapsed_s=time.monotonic() - began)
    while not training.is_over and not stop.is_set():
        scores = training.run_epoch(draw, validation, stop=stop, progress=observer.learning)
        if scores is None:
            break
        observer.checked(scores, is_best=scores.merit == training.best)
        _write_report(request, training, validation, elapsed_s=time.monotonic() - began)
    return max(training.history, key=lambda scores: scores.merit, default=None)


def _prepare(request: TrainRequest) -> Training:
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
    try:
        request.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{request.out}: expected a folder to write to, got: {error.strerror}; "
            "choose another --out"
        ) from error
    training = Training(
        settings=request.settings,
        device=torch.device(request.device),
        out=request.out,
        is_fine_tuning=init is not None,
    )
    if request.resume:
        training.resume()
    else:
        training.begin(network)
    return training


def _sources(request: TrainRequest, observer: TrainObserver) -> tuple[Draw, Draw]:
    """What draws the pictures to learn from, and those to check on."""
    if request.images is None or request.masks is None:
        simulated = _Simulated(_bank(request, observer))
        return simulated, _Simulated(_bank(request, observer, is_unseen=True))
    learnt, held_back = load_own_fish(request.images, request.masks)
    simulated = _Simulated(_bank(request, observer))
    return _Mixed(simulated, learnt, request.settings.own_share), _Own(held_back)


def _bank(request: TrainRequest, observer: TrainObserver, *, is_unseen: bool = False) -> Bank:
    settings = request.settings
    counts = (settings.bank_fish, settings.bank_backgrounds)
    num_fish, num_backgrounds = (max(1, n // _UNSEEN) for n in counts) if is_unseen else counts
    done = 0

    def progress() -> None:
        nonlocal done
        done += 1
        observer.drawing(done, num_fish + num_backgrounds)

    return load_or_make_bank(
        request.out / "cache",
        num_fish=num_fish,
        num_backgrounds=num_backgrounds,
        seed=settings.seed + is_unseen,
        progress=progress,
    )


@dataclass(frozen=True)
class _Simulated:
    """Classes, not closures: worker processes get them sent."""

    bank: Bank

    def __call__(self, rng: np.random.Generator) -> Sample:
        return draw_sample(rng, self.bank)


@dataclass(frozen=True)
class _Own:
    cuts: Sequence[Cut]

    def __call__(self, rng: np.random.Generator) -> Sample:
        return draw_own(rng, self.cuts[int(rng.integers(len(self.cuts)))])


@dataclass(frozen=True)
class _Mixed:
    simulated: _Simulated
    cuts: Sequence[Cut]
    own_share: float

    def __call__(self, rng: np.random.Generator) -> Sample:
        is_own = rng.random() < self.own_share
        return _Own(self.cuts)(rng) if is_own else self.simulated(rng)


def _write_report(
    request: TrainRequest, training: Training, validation: Pictures, *, elapsed_s: float
) -> None:
    best = max(training.history, key=lambda scores: scores.merit)
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
    draw_curve(training.history, request.out / "curve.png")
    if best is training.history[-1]:
        draw_worst(training, validation, request.out / "worst.png")
