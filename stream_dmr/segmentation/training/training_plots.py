"""Pictures of a training: the course of loss and scores, and the worst masks."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from stream_dmr.segmentation.segmenter import resize
from stream_dmr.segmentation.training.sample_dataset import SampleDataset
from stream_dmr.segmentation.training.training_sample import TrainingSample
from stream_dmr.segmentation.training.unet_trainer import EpochScores, UNetTrainer

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
    curves = {
        "mean IoU": ([s.iou for s in history], (180, 90, 0)),
        "10th percentile of IoU": ([s.iou_p10 for s in history], (220, 170, 90)),
        "heads found at the head": ([s.ends_right for s in history], (60, 140, 30)),
        f"loss / {highest:.2f}": (
            [None if s.loss is None else s.loss / highest for s in history],
            (90, 90, 200),
        ),
    }
    for index, (name, (values, colour)) in enumerate(curves.items()):
        steps = max(len(values) - 1, 1)
        points = [_place(k / steps, v) for k, v in enumerate(values) if v is not None]
        for one, other in pairwise(points):
            cv2.line(canvas, one, other, colour, 2)
        _write(canvas, name, (_EDGE + 170 * index, 18), colour)
    _write(canvas, f"{history[-1].epoch} epochs", (_WIDTH - 110, _HEIGHT - 12), _TEXT)
    cv2.imwrite(str(path), canvas)


def draw_worst_masks(training: UNetTrainer, validation: SampleDataset, path: Path) -> None:
    """Write the validation pictures of least IoU; green: true outline, red: found one."""
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
