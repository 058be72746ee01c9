"""Progress of a training on the terminal."""

import sys

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from stream_dmr.training.train_settings import TrainSettings
from stream_dmr.training.train_unet import TrainObserver
from stream_dmr.training.unet_trainer import EpochScores


class TrainDisplay(TrainObserver):
    """Progress on stderr: a bar per task on a terminal, and a line per epoch."""

    def __init__(self, settings: TrainSettings) -> None:
        self._console = Console(file=sys.stderr, highlight=False, soft_wrap=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._settings = settings
        self._drawing = self._progress.add_task("drawing fish", total=1, visible=False)
        self._epoch = self._progress.add_task("epoch 1", total=settings.crops_per_epoch)

    def __enter__(self) -> "TrainDisplay":
        self._progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()

    def patches_drawn(self, num_done: int, num_all: int) -> None:
        is_unfinished = num_done < num_all
        self._progress.update(
            self._drawing, completed=num_done, total=num_all, visible=is_unfinished
        )

    def crops_trained(self, num_crops: int) -> None:
        self._progress.update(self._epoch, advance=num_crops)

    def epoch_done(self, scores: EpochScores, *, is_best: bool) -> None:
        loss = "before training" if scores.loss is None else f"loss {scores.loss:.3f}"
        heads = "" if scores.ends_right is None else f", heads right {scores.ends_right:.2f}"
        self._console.print(
            f"epoch {scores.epoch}/{self._settings.epochs}: {loss}, IoU {scores.iou:.3f}"
            f"{heads}{', best' * is_best}"
        )
        self._progress.reset(self._epoch, description=f"epoch {scores.epoch + 1}")
