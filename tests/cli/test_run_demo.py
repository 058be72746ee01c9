"""The demo: lengths beside the truth, and a fish that was not measured is no success."""

from pathlib import Path

import pytest

from stream_dmr.cli.demo import SCENE, measure_scene
from tests.support.tiny_clip import write_clip


@pytest.mark.parametrize(("num_frames", "is_measured"), [(4, True), (2, False)])
def test_every_fish_must_be_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], num_frames: int, is_measured: bool
):
    clip, out = tmp_path / "clip", tmp_path / "out"
    write_clip(clip, num_frames=num_frames)
    (clip / "tiny.ply").rename(clip / "species.ply")
    (clip / "tiny.toml").rename(clip / "species.toml")
    (clip / "truth.csv").write_text("track_id,length_mm\n1,800\n")
    for _ in range(2):  # again and again, into the same folder
        assert measure_scene(clip, out=out, config=clip / "quick.toml") == is_measured
    printed = capsys.readouterr().out
    assert "800.0" in printed
    assert f"view {out}" in printed


def test_the_embedded_scene_is_whole():
    for name in ("video.mp4", "boxes.txt", "calibration.yaml", "truth.csv", "species.ply"):
        assert (SCENE / name).is_file(), "make it with: stream-dmr simulate --out recordings/demo"
    assert any((SCENE / "masks").iterdir())
