"""A training: its files, resuming, fine-tuning, and what is refused."""

import json
import threading

import numpy as np
import pytest
from typer.testing import CliRunner

from stream_dmr.cli.main import app
from stream_dmr.errors import ModelError, OutputError
from stream_dmr.networks.unet import SHIPPED, load_weights
from stream_dmr.training.train_settings import TrainSettings
from stream_dmr.training.train_unet import TrainObserver, TrainRequest, train_unet
from tests.support.command import invoke

# Smaller than a user may ask for.
TINY = TrainSettings(epochs=2, learning_rate=5e-3).model_copy(
    update={
        **{"crops_per_epoch": 4, "validation_crops": 2, "batch_size": 2},
        **{"bank_fish": 4, "bank_backgrounds": 4},
    }
)


def request(out, **changes):
    return TrainRequest(out=out, **({"settings": TINY} | changes))


def never():
    return threading.Event()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A whole training of two epochs, and its best scores."""
    out = tmp_path_factory.mktemp("trained")
    return out, train_unet(request(out), stop=never())


def history(out):
    return json.loads((out / "scores.json").read_text())["history"]


def test_a_training_writes_weights_scores_and_pictures(trained):
    out, best = trained
    report = json.loads((out / "scores.json").read_text())
    assert [epoch["epoch"] for epoch in report["history"]] == [1, 2]
    assert report["history"][1]["loss"] < report["history"][0]["loss"]
    assert report["best"]["iou"] == best.iou == max(e["iou"] for e in report["history"])
    assert report["settings"] == TINY.model_dump()
    for name in ("unet.onnx", "unet.pt", "last.pt", "curve.png", "worst.png"):
        assert (out / name).stat().st_size > 1000
    load_weights(out / "unet.pt")


class StopAfterFirst(TrainObserver):
    def __init__(self):
        self.stop, self.num_drawn = threading.Event(), 0

    def epoch_done(self, scores, *, is_best):
        self.stop.set()


class StopAtFirstPatch(StopAfterFirst):
    def patches_drawn(self, num_done, num_all):
        self.num_drawn += 1
        self.stop.set()


def test_a_training_is_stopped_while_its_fish_are_simulated(tmp_path):
    observer = StopAtFirstPatch()
    assert train_unet(request(tmp_path), stop=observer.stop, observer=observer) is None
    assert observer.num_drawn == 1
    assert list(tmp_path.iterdir()) == []


def test_a_resumed_training_equals_an_uninterrupted_one(trained, tmp_path):
    whole, best = trained
    observer = StopAfterFirst()
    train_unet(request(tmp_path), stop=observer.stop, observer=observer)
    assert len(history(tmp_path)) == 1
    assert train_unet(request(tmp_path, resume=True), stop=never()) == best
    assert history(tmp_path) == history(whole)
    one, other = (load_weights(out / "unet.pt").state_dict() for out in (whole, tmp_path))
    for name, value in one.items():
        np.testing.assert_array_equal(value.numpy(), other[name].numpy())


def test_fine_tuning_ends_where_nothing_improves_and_never_with_worse_weights(tmp_path):
    wild = TINY.model_copy(update={"learning_rate": 0.1, "epochs": 9, "patience": 1})
    best = train_unet(request(tmp_path, settings=wild, init=SHIPPED), stop=never())
    start, spoilt = history(tmp_path)
    assert best.epoch == start["epoch"] == 0
    assert start["loss"] is None
    assert spoilt["iou"] < start["iou"]
    one, other = (load_weights(path).state_dict() for path in (SHIPPED, tmp_path / "unet.pt"))
    for name, value in one.items():
        np.testing.assert_array_equal(value.numpy(), other[name].numpy())
    train_unet(request(tmp_path, settings=wild, resume=True, init=SHIPPED), stop=never())
    assert len(history(tmp_path)) == 2  # it was over
    other = tmp_path / "unet.pt"
    with pytest.raises(ModelError, match="expected the weights that this training began with"):
        train_unet(request(tmp_path, settings=wild, resume=True, init=other), stop=never())
    assert (tmp_path / "worst.png").exists()


def test_impossible_requests_are_refused_before_training(trained, tmp_path):
    out, _ = trained
    with pytest.raises(OutputError, match=r"last\.pt of an earlier one"):
        train_unet(request(out), stop=never())
    with pytest.raises(ModelError, match="expected the checkpoint"):
        train_unet(request(tmp_path / "new", resume=True), stop=never())
    other = TINY.model_copy(update={"learning_rate": 1e-3})
    with pytest.raises(ModelError, match="of the same settings"):
        train_unet(request(out, settings=other, resume=True), stop=never())
    with pytest.raises(ModelError, match="it had none, got one; give the options"):
        train_unet(request(out, resume=True, init=SHIPPED), stop=never())
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="expected a place to write to"):
        train_unet(request(tmp_path / "file"), stop=never())


@pytest.mark.parametrize(
    "arguments",
    [
        ["--images", "nowhere", "--masks", "nowhere"],
        ["--init", "nowhere.pt"],
        ["--config", "nowhere.toml"],
        ["--resume"],
    ],
)
def test_the_command_says_what_is_wrong(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["train", "--out", "out", *arguments])
    assert result.exit_code != 0
    assert "expected" in str(result.exception)


def test_weights_of_one_s_own_are_not_written_over(tmp_path):
    own = tmp_path / "unet.onnx"
    own.write_bytes(b"weights of another program")
    result = CliRunner().invoke(app, ["train", "--out", str(tmp_path)])
    assert "--overwrite" in str(result.exception)
    assert own.read_bytes() == b"weights of another program"
    assert [*tmp_path.iterdir()] == [own]


def test_own_fish_are_trained_on_before_own_backgrounds(vessel):
    out = vessel / "out"
    tiny = TINY.model_copy(update={"epochs": 1})
    own = {"images": vessel / "images", "masks": vessel / "masks"}
    best = train_unet(
        request(out, settings=tiny, backgrounds=vessel / "images", **own), stop=never()
    )
    assert best is not None
    assert len(history(out)) == 2


def test_backgrounds_without_own_fish_are_refused():
    outcome = invoke("train", {"--backgrounds": "x"})
    assert outcome.code == 2
    assert "--images" in outcome.error


def test_images_without_masks_are_refused():
    outcome = invoke("train", {"--images": "x"})
    assert outcome.code == 2
    assert "belong together" in outcome.error
