"""Species from a classifier that is trained here, to tables, recordings, body forms and replays."""

import csv
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from stream_dmr.messages import FittedMesh
from stream_dmr.recording.reading import decoded_messages, open_recordings
from stream_dmr.simulation.write_scene import write_scene
from stream_dmr.store.fish import read_stored_fish
from tests.support.command import invoke
from tests.support.small_classifier import crops_of, train_classifier
from tests.support.trip import NAMES, small_scene

CODES = {"halibut": "HAP", "conger": "COE"}


def species_of(scene: Path) -> dict[int, str]:
    """Track id -> code."""
    with (scene / "species.csv").open() as file:
        return {int(row["track_id"]): CODES[row["species"]] for row in csv.DictReader(file)}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = tmp_path_factory.mktemp("learnt")
    write_scene(scene, small_scene(num_fish=8, num_frames=40, seed=1), species=NAMES)
    codes, pictures = species_of(scene), defaultdict[str, list[np.ndarray]](list)
    for crop in crops_of(scene):
        assert crop.image is not None
        pictures[codes[crop.track_id]].append(crop.image)
    return train_classifier(scene / "species.onnx", pictures)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, small_scene(num_fish=4, num_frames=24, seed=5), species=NAMES)
    return folder


@pytest.fixture(scope="module")
def out(scene: Path, model: Path) -> Path:
    config = scene / "config.toml"
    config.write_text(f'[species]\nmodel = "{model}"\nmin_share = 0.8\n')
    options = {"--source": "video.mp4", "--masks": "masks", "--calibration": "calibration.yaml"}
    options = {name: str(scene / value) for name, value in options.items()}
    options |= {"--config": str(config), "--out": str(scene / "out"), "--template": "auto"}
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    (scene / "printed.txt").write_text(outcome.out)
    return scene / "out"


@pytest.mark.slow
def test_every_fish_has_its_species(out: Path, scene: Path):
    fish = read_stored_fish(out / "lengths.db")
    assert {one.estimate.track_id: one.estimate.species_code for one in fish} == species_of(scene)
    assert all(0.8 <= (one.estimate.species_share or 0) <= 1 for one in fish)
    assert "species: 2 HAP, 2 COE" in (scene / "printed.txt").read_text()


@pytest.mark.slow
def test_the_recording_has_what_the_classifier_said_of_each_frame(out: Path):
    recording = open_recordings([out / "recording.mcap"])
    fits = [message for message, _ in decoded_messages(recording, [FittedMesh])]
    assert fits
    for fit in fits:
        assert isinstance(fit, FittedMesh)
        assert set(fit.species) == {"HAP", "COE"}
        assert sum(fit.species.values()) == pytest.approx(1)


@pytest.mark.slow
def test_each_fish_has_the_body_form_of_its_species(out: Path, scene: Path):
    recording = open_recordings([out / "recording.mcap"])
    shapes = recording.header.candidates
    assert shapes is not None
    names = [one.name for one in shapes]
    assert set(names) <= {"halibut", "eel"}
    codes = species_of(scene)
    for message, _ in decoded_messages(recording, [FittedMesh]):
        assert isinstance(message, FittedMesh)
        if message.shape is not None and message.species[codes[message.track_id]] > 0.99:
            form = names[message.shape.candidate or 0]
            assert form == {"HAP": "halibut", "COE": "eel"}[codes[message.track_id]]


@pytest.mark.slow
@pytest.mark.parametrize("first", ["smooth", "fit"])
def test_it_replays_to_the_last_bit_without_the_model(
    out: Path, model: Path, tmp_path: Path, first: str
):
    away = model.rename(tmp_path / "away.onnx")
    try:
        outcome = invoke(f"replay {out} --from {first} --check")
    finally:
        away.rename(model)
    assert outcome.code == 0, outcome.out + outcome.err
    assert "to the last bit" in outcome.out


@pytest.mark.slow
def test_a_higher_threshold_makes_fish_unsure(out: Path, tmp_path: Path):
    config = tmp_path / "config.toml"
    config.write_text("[species]\nmin_share = 1.0\n")
    outcome = invoke(f"replay {out} --from smooth --config {config} --out {tmp_path / 'again'}")
    assert outcome.code == 0, outcome.err
    fish = read_stored_fish(tmp_path / "again" / "lengths.db")
    assert {one.estimate.species_code for one in fish} == {"unsure"}
    assert all((one.estimate.species_share or 0) > 0.8 for one in fish)
