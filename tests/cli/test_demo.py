"""The demo: lengths beside the truth, and a fish that was not measured is no success."""

from pathlib import Path

import pytest

from stream_dmr.cli.run import print_beside_truth
from tests.support.command import invoke, rows
from tests.support.tiny_clip import write_clip


@pytest.mark.parametrize(("truth", "is_complete"), [("1,800\n", True), ("1,800\n2,700\n", False)])
def test_a_fish_without_a_length_is_noticed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], truth: str, is_complete: bool
):
    lengths, truths = tmp_path / "lengths.csv", tmp_path / "truth.csv"
    lengths.write_text("track_id,length_mm\n1,790\n")
    truths.write_text(f"track_id,length_mm\n{truth}")
    assert print_beside_truth(lengths, truths) == is_complete
    assert "800.0" in capsys.readouterr().out


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """A scene without fish in the place of the embedded one; returns the options of `run`."""
    folder = tmp_path / "scene"
    options = write_clip(folder, fish=[[], []])
    for suffix in (".ply", ".toml"):
        (folder / f"tiny{suffix}").rename(folder / f"species{suffix}")
    (folder / "truth.csv").write_text("track_id,length_mm\n1,800\n")
    monkeypatch.setattr("stream_dmr.simulation.DEMO_SCENE", folder)
    monkeypatch.chdir(tmp_path)
    return options | {"--template": str(folder / "species.ply"), "--out": "runs/demo"}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("options", [{}, pytest.param({"--out": "mine"}, marks=pytest.mark.slow)])
def test_the_results_of_an_earlier_demo_are_replaced(
    scene: dict[str, str], options: dict[str, str]
):
    out = Path(options.get("--out", "runs/demo"))
    assert "was not measured" in invoke("demo", options).err
    before = contents(out)
    assert "was not measured" in invoke("demo", options).err
    assert contents(out).keys() == before.keys()
    assert contents(out)["lengths.db"] != before["lengths.db"]


def test_the_results_of_a_run_are_not_replaced_by_a_demo(scene: dict[str, str]):
    assert invoke("run", scene).code == 0  # as of a video that is called demo.mp4
    before = contents(Path("runs/demo"))
    refused = invoke("demo")
    assert refused.code == 2
    assert "--overwrite" in refused.error
    assert contents(Path("runs/demo")) == before
    assert "was not measured" in invoke("demo", {"--overwrite": None}).err


@pytest.mark.slow  # `make demo` is part of CI
def test_demo_measures_the_embedded_scene_from_its_video(tmp_path: Path):
    out = tmp_path / "out"
    outcome = invoke("demo", {"--out": str(out)})
    assert outcome.code == 0, outcome.err
    assert "4 of 4" in outcome.out
    assert f"view {out}" in outcome.out
    assert [row["status"] for row in rows(out / "lengths.csv")] == ["measured"] * 4
