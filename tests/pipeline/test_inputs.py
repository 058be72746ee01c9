"""The inputs of a run, read and checked before its first frame."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.errors import CalibrationError, UserError
from stream_dmr.files import sha256_of
from stream_dmr.pipeline.config import parse_config
from stream_dmr.pipeline.run_inputs import Inputs, checked_inputs
from tests.support.fish_run import request
from tests.support.tiny_clip import write_clip


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs") / "clip"
    write_clip(folder, num_frames=2)
    return folder


def checked(clip: Path, **other: object) -> Iterator[Inputs]:
    inputs = checked_inputs(request(clip, clip.parent / "out", **other))
    with closing(inputs.reader):
        yield inputs


def test_files_are_recorded_with_their_places_and_hashes(clip: Path):
    for inputs in checked(clip):
        given = inputs.header().inputs
        assert given is not None
        assert given.source.path == str(clip / "video.mp4")
        assert given.source.sha256 == sha256_of(clip / "video.mp4")
        assert given.calibration is not None
        assert given.calibration.is_unchanged()
        assert given.boxes is None


def test_the_header_holds_what_a_replay_needs(clip: Path):
    for inputs in checked(clip):
        header = inputs.header()
        assert parse_config(header.config_toml, where="header") == inputs.config
        assert header.calibration_file == (clip / "calibration.yaml").read_bytes()
        assert header.template is inputs.template
        assert header.source == "video.mp4"


def test_without_a_calibration_there_is_none(clip: Path):
    for inputs in checked(clip, calibration=None):
        assert inputs.calibration is None
        assert inputs.header().calibration_file == b""


def test_pose_and_stills_are_settings(clip: Path):
    for inputs in checked(clip, pose="lying", stills=True):
        assert inputs.config.localize.rests_on_plane
        assert inputs.config.smooth_length.min_frames == 1


def test_a_file_is_measured_from_its_start(clip: Path):
    for inputs in checked(clip):
        assert not inputs.is_endless
        assert not inputs.resumes


def test_a_calibration_of_another_size_is_refused_and_the_source_closed(clip: Path, tmp_path: Path):
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((50, 70, 3), np.uint8))
    with pytest.raises(CalibrationError, match="calibrate with pictures of 70x50 px"):
        checked_inputs(request(clip, tmp_path, source=str(tmp_path), masks=clip / "masks"))


@pytest.mark.parametrize("option", ["calibration", "config", "masks", "template"])
def test_a_missing_file_is_named(clip: Path, option: str):
    missing = clip / "missing.ply"
    with pytest.raises(UserError, match=r"missing\.ply"):
        checked_inputs(
            request(clip, clip, **{option: str(missing) if option == "template" else missing})
        )
