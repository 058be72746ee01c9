"""Every example runs on the bundled scene, and prints lengths near the true ones."""

import csv
import re
import runpy
import sys
from pathlib import Path

import pytest

import stream_dmr as sd

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def run_example(number: int, *arguments: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [EXAMPLES[number - 1].name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES[number - 1]), run_name="__main__")


def true_lengths() -> list[float]:
    with (sd.DEMO_SCENE / "truth.csv").open(newline="") as file:
        return [float(row["length_mm"]) for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that example 01 writes; examples 02 and 03 read it."""
    out = tmp_path_factory.mktemp("examples") / "measured"
    run_example(1, out)
    return out


def test_examples_are_numbered_and_short():
    assert [path.name[:3] for path in EXAMPLES] == ["01_", "02_", "03_", "04_", "05_"]
    assert all(len(path.read_text().splitlines()) <= 40 for path in EXAMPLES)


@pytest.mark.slow
def test_measure_a_video_holds_the_true_lengths(measured: Path):
    for fish, true_mm in zip(sd.Run(measured).fish, true_lengths(), strict=True):
        assert fish.ci95_low_mm is not None
        assert fish.ci95_high_mm is not None
        assert fish.ci95_low_mm < true_mm < fish.ci95_high_mm


@pytest.mark.slow
def test_lengths_with_pandas_counts_every_fish(
    measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run_example(2, measured, tmp_path / "out")
    assert "4 of 4 fish measured" in capsys.readouterr().out
    table = (tmp_path / "out" / "length_classes.csv").read_text()
    assert sum(int(number) for number in re.findall(r",(\d+)$", table, re.MULTILINE)) == 4


@pytest.mark.slow
def test_replay_with_a_stricter_setting_uses_fewer_frames(
    measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run_example(3, measured, tmp_path / "out")
    assert capsys.readouterr().out.count("strict") == 4
    before, after = (
        sum(fish.frames_used for fish in sd.Run(folder).fish)
        for folder in (measured, tmp_path / "out" / "replay")
    )
    assert 0 < after < before


@pytest.mark.slow
def test_own_detector_finds_the_four_fish(tmp_path: Path):
    run_example(4, tmp_path)
    lengths = [fish.length_mm for fish in sd.Run(tmp_path / "run").fish if fish.length_mm]
    assert lengths == pytest.approx(true_lengths(), rel=0.1)


@pytest.mark.slow
def test_stills_print_a_length_for_every_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run_example(5, tmp_path)
    printed = capsys.readouterr().out
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {
        *re.findall(r"^(\d{3}\.png): \d+ mm", printed, re.MULTILINE)
    }
