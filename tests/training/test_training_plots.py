"""A trainer's scores and the pictures of a training, on a network of random weights."""

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.segmenter import resize
from stream_dmr.training.samples import SampleDataset, TrainingSample
from stream_dmr.training.train_settings import TrainSettings
from stream_dmr.training.train_unet import TILE_PX, draw_training_curve, draw_worst_masks
from stream_dmr.training.unet_trainer import EpochScores, UNetTrainer
from tests.support.frames import ellipse_mask

SETTINGS = TrainSettings(epochs=2, crops_per_epoch=32, validation_crops=16, batch_size=8)
SIZE = 64


def draw_sample(rng: np.random.Generator, _size_px: int) -> TrainingSample:
    """A light ellipse on a dark ground."""
    mask = ellipse_mask(size=(SIZE, SIZE), center=(32, 32), axes=(24, 8), angle=rng.uniform(0, 180))
    image = rng.integers(0, 40, (SIZE, SIZE, 3)).astype(np.uint8)
    image[mask > 0] += 150
    return TrainingSample(
        image=image,
        mask=mask.astype(np.float32),
        in_box=np.ones((SIZE, SIZE), np.float32),
        ends_px=None,
    )


def trainer(out: Path, **changes: object) -> UNetTrainer:
    settings = SETTINGS.model_copy(update=changes)
    made = UNetTrainer(settings, torch.device("cpu"), out, is_fine_tuning=False)
    made.begin(None)
    return made


def samples(seed: int = 0) -> SampleDataset:
    return SampleDataset(draw_sample, size=4, batch_size=8, seed=(seed,))


def scores(epoch: int, iou: float, *, loss: float | None = 1.0) -> EpochScores:
    return EpochScores(epoch=epoch, loss=loss, iou=iou, iou_p10=iou / 2, ends_right=None)


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> UNetTrainer:
    made = trainer(tmp_path_factory.mktemp("trainer"))
    made.check_start(samples())
    return made


def test_scores_are_those_of_the_masks_that_it_finds(checked: UNetTrainer):
    for index, iou in enumerate(checked.ious.tolist()):
        sample = samples()[index]
        mask, truth = checked.predict(sample), sample.mask > 0.5
        assert iou == pytest.approx((mask & truth).sum() / (mask | truth).sum(), abs=1e-3)
    assert checked.history[0].iou == pytest.approx(float(checked.ious.mean()), abs=1e-6)


def test_a_stopped_epoch_keeps_nothing(checked: UNetTrainer):
    stop = threading.Event()
    stop.set()
    before = list(checked.history)
    assert checked.run_epoch(draw_sample, samples(), stop=stop, progress=lambda n: None) is None
    assert checked.history == before


def test_a_checkpoint_of_other_settings_is_refused(tmp_path: Path):
    with pytest.raises(ModelError, match="found none"):
        trainer(tmp_path).resume()


@pytest.mark.parametrize(("ious", "is_over"), [([0.5], False), ([0.5, 0.4, 0.4], True)])
def test_training_ends_after_its_epochs(tmp_path: Path, ious: list[float], is_over: bool):
    made = trainer(tmp_path)
    made.history = [scores(epoch, iou) for epoch, iou in enumerate(ious)]
    assert made.is_over == is_over


def test_training_ends_where_nothing_improves(tmp_path: Path):
    made = trainer(tmp_path, epochs=30, patience=2)
    made.history = [scores(epoch, iou) for epoch, iou in enumerate([0.1, 0.5, 0.4])]
    assert not made.is_over
    made.history.append(scores(3, 0.45))
    assert made.is_over


def test_the_worst_masks_come_first(checked: UNetTrainer, tmp_path: Path):
    draw_worst_masks(checked, samples(), tmp_path / "worst.png")
    picture = cv2.imread(str(tmp_path / "worst.png"))
    assert picture.shape == (2 * TILE_PX, 8 * TILE_PX, 3)
    worst = int(np.argmin(checked.ious.numpy()))
    image = resize(samples()[worst].image, TILE_PX)
    np.testing.assert_array_equal(picture[:TILE_PX, :TILE_PX], image)
    assert not picture[:, 4 * TILE_PX :].any()  # four samples, eight to a row


def test_a_better_score_is_drawn_higher(tmp_path: Path):
    heights = list[float]()
    for iou in (0.2, 0.8):
        draw_training_curve([scores(0, iou, loss=None), scores(1, iou)], tmp_path / "curve.png")
        picture = cv2.imread(str(tmp_path / "curve.png"))
        rows, _ = np.nonzero((picture[40:] == (180, 90, 0)).all(axis=2))
        heights.append(float(rows.mean()))
    assert heights[1] < heights[0]
