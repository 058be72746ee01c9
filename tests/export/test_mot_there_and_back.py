"""What `export --mot` writes is MOTChallenge's, and gives `run --boxes` the same tracks again."""

from pathlib import Path

import pytest

from stream_dmr.messages import FishCrop
from stream_dmr.store.verdicts import Verdict, add_verdict
from tests.support.command import invoke
from tests.support.fish_run import measure
from tests.support.reading import read_messages


def boxes_of(run: Path) -> dict[tuple[int, int], list[float]]:
    """By frame and fish."""
    messages = read_messages(run / "recording.mcap", [FishCrop])
    crops = [one for one in messages if isinstance(one, FishCrop)]
    return {(one.frame_index, one.track_id): one.bbox_xyxy_px.tolist() for one in crops}


def test_tracks_are_the_same_but_for_rejected_fish(tmp_path: Path):
    run, clip = measure(tmp_path), tmp_path / "clip"
    path = tmp_path / "exported" / "tracks.mot.txt"
    done = invoke(f"export {run} --mot", {"--out": str(path.parent)})
    assert done.code == 0, done.err
    assert "10 boxes" in done.out
    rows = [line.split(",") for line in path.read_text().splitlines()]
    assert [(int(row[0]), int(row[1])) for row in rows] == sorted(boxes_of(run))
    assert {tuple(row[6:]) for row in rows} == {("1", "-1", "-1", "-1")}
    given = {"--source": str(clip / "video.mp4"), "--template": str(clip / "tiny.ply")}
    given |= {"--calibration": str(clip / "calibration.yaml"), "--config": str(clip / "quick.toml")}
    again = tmp_path / "again"
    done = invoke("run", given | {"--boxes": str(path), "--out": str(again)})
    assert done.code == 0, done.err
    assert boxes_of(again) == {key: pytest.approx(box) for key, box in boxes_of(run).items()}
    verdict = Verdict(track_id=1, kind="reject", reason="a glove", reviewer="Ada")
    add_verdict(run / "lengths.db", verdict)
    done = invoke(f"export {run} --mot --overwrite", {"--out": str(path.parent)})
    assert done.code == 0, done.err
    assert {line.split(",")[1] for line in path.read_text().splitlines()} == {"2"}
