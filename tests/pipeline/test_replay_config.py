"""The settings of a replay: given ones from its first stage on, recorded ones before it."""

from pathlib import Path

import pytest

from stream_dmr.pipeline.config import Config, lying, parse_config, stills, to_toml
from stream_dmr.pipeline.replay_inputs import replay_config
from stream_dmr.pipeline.session import STAGES

RECORDED = """\
[read_frames]
orientation = "sensor"
[crop_fish]
margin = 0.2
[species]
model = "mine.onnx"
forms = ["HAP=halibut"]
[fit_mesh]
hang = "camera"
edge_shift_px = 0.3
min_mask_px = 11
[localize]
min_iou = 0.5
[smooth_length]
min_frames = 4
"""
STAGE_OF = {"crop_fish": "crop", "fit_mesh": "fit", "localize": "localize"}


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text("[smooth_length]\nmin_frames = 5\n[species]\nmin_share = 0.8\n")
    return path


@pytest.mark.parametrize("first", STAGES)
def test_what_the_file_leaves_out_is_recorded_before_the_stage_and_default_after(mine, first):
    recorded, default = parse_config(RECORDED, where=""), parse_config("", where="")
    config = replay_config(mine, RECORDED, first=first)
    for table, stage in STAGE_OF.items():
        is_before = [*STAGES].index(stage) < [*STAGES].index(first)
        assert getattr(config, table) == getattr(recorded if is_before else default, table)
    assert config.read_frames.orientation == "sensor"  # frames are always those of the recording
    assert config.smooth_length.min_frames == 5
    assert config.species.min_share == 0.8
    assert config.species.model == ("" if first == "crop" else "mine.onnx")
    assert config.species.forms == ([] if first in ("crop", "fit") else ["HAP=halibut"])


@pytest.mark.parametrize("first", STAGES)
def test_a_file_keeps_the_conditions_of_the_run(mine: Path, tmp_path: Path, first):
    run = lying(stills(Config(), is_calibrated=True))
    config = replay_config(mine, to_toml(run), first=first)
    kept = config.model_copy(update={"species": run.species})
    smooth = run.smooth_length.model_copy(update={"min_frames": 5})  # what the file says
    assert kept == run.model_copy(update={"smooth_length": smooth})
    path = tmp_path / "hanging.toml"
    path.write_text("[localize]\nrests_on_plane = false\n")
    lines: list[str] = []
    hangs = replay_config(path, to_toml(run), first="crop", on_notice=lines.append)
    assert hangs.localize == Config().localize
    [line] = lines
    assert "rests_on_plane = false, so the run with --pose lying is replayed without" in line


@pytest.mark.parametrize("first", STAGES)
def test_the_recorded_settings_may_be_given(tmp_path: Path, first):
    path = tmp_path / "same.toml"
    path.write_text(RECORDED)
    assert replay_config(path, RECORDED, first=first) == parse_config(RECORDED, where="")


def test_other_ones_of_earlier_stages_stay_as_recorded_and_are_named(tmp_path: Path):
    path = tmp_path / "other.toml"
    path.write_text("[localize]\nmin_iou = 0.6\n[smooth_length]\nmin_frames = 7\n")
    lines: list[str] = []
    config = replay_config(path, RECORDED, first="smooth", on_notice=lines.append)
    assert config.localize.min_iou == 0.5
    assert config.smooth_length.min_frames == 7
    [line] = lines
    assert line.endswith(": [localize] min_iou = 0.5")
    assert replay_config(path, RECORDED, first="localize").localize.min_iou == 0.6


def test_fish_of_a_recording_older_than_the_setting_hang_in_the_plane():
    older = RECORDED.replace('hang = "camera"\n', "")
    assert replay_config(None, older, first="fit").fit_mesh.hang == "plane"
    assert replay_config(None, RECORDED, first="fit").fit_mesh.hang == "camera"
