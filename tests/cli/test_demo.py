"""The demo: lengths beside the truth, and a fish that was not measured is no success."""

from pathlib import Path

import pytest

from stream_dmr.cli.demo import print_beside_truth
from tests.support.command import invoke, rows


@pytest.mark.parametrize(("truth", "is_complete"), [("1,800\n", True), ("1,800\n2,700\n", False)])
def test_a_fish_without_a_length_is_noticed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], truth: str, is_complete: bool
):
    lengths, truths = tmp_path / "lengths.csv", tmp_path / "truth.csv"
    lengths.write_text("track_id,length_mm\n1,790\n")
    truths.write_text(f"track_id,length_mm\n{truth}")
    assert print_beside_truth(lengths, truths) == is_complete
    assert "800.0" in capsys.readouterr().out


@pytest.mark.slow  # `make demo` is part of CI
def test_demo_measures_the_embedded_scene_from_its_video_again_and_again(tmp_path: Path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "lengths.csv").write_text("of an earlier demo\n")
    outcome = invoke("demo", {"--out": str(out)})
    assert outcome.code == 0, outcome.err
    assert "4 of 4" in outcome.out
    assert f"view {out}" in outcome.out
    assert [row["status"] for row in rows(out / "lengths.csv")] == ["measured"] * 4
