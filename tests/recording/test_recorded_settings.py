"""Settings of a run, as its recording has them."""

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.pipeline.config import parse_config
from stream_dmr.recording.reading import open_recordings, recorded_settings

GOLDEN = Path(__file__).parents[2] / "recordings" / "golden"


def test_a_table_is_the_run_s_and_a_newer_one_has_its_defaults():
    recording = open_recordings([GOLDEN])
    of_run = parse_config(recording.header.config_toml, where="golden").smooth_length
    assert recorded_settings(recording.header, "smooth_length", SmoothLengthSettings) == of_run
    newer = recorded_settings(recording.header, "not_yet_there", SmoothLengthSettings)
    assert newer == SmoothLengthSettings()


def test_a_config_is_parsed_once(monkeypatch: pytest.MonkeyPatch):
    header = open_recordings([GOLDEN]).header
    header = replace(header, config_toml=header.config_toml + "\n# of this test\n")
    parsed, loads = list[str](), tomllib.loads

    def counting(text: str) -> dict[str, object]:
        parsed.append(text)
        return loads(text)

    monkeypatch.setattr(tomllib, "loads", counting)
    for _ in range(3):
        recorded_settings(header, "smooth_length", SmoothLengthSettings)
    assert len(parsed) == 1
