"""The data set of a batch: a file for each finished video, in its partition, and no others."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from pyarrow import parquet

from stream_dmr.batch.dataset import publish, withdraw_others, write_tables
from stream_dmr.batch.manifest import Job
from stream_dmr.pipeline.haul_log import write_haul
from stream_dmr.store.batch_folder import TABLE_KINDS
from stream_dmr.store.verdicts import Verdict, add_verdict
from tests.support.command import rows
from tests.support.fish_run import measure

OPTIONS = {"source": "/videos/clip.mp4", "vessel": "Sea/Bird", "trip": "7", "haul": "2"}
JOB = Job(name="clip", given=OPTIONS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = measure(tmp_path_factory.mktemp("dataset"), haul=JOB.options.haul)
    write_tables(out, JOB)
    return out


def files(out: Path) -> list[str]:
    return sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())


def test_tables_hold_what_the_csv_files_hold(folder: Path):
    fish = parquet.read_table(folder / "fish.parquet").to_pylist()
    lengths = rows(folder / "lengths.csv")
    assert {str(one["track_id"]) for one in fish} == {row["track_id"] for row in lengths}
    frames = parquet.read_table(folder / "frames.parquet").to_pylist()
    recorded = rows(folder / "frames.csv")
    assert len(frames) == len(recorded)
    assert [frame["accepted"] for frame in frames] == [r["accepted"] == "true" for r in recorded]
    assert {frame["haul"] for frame in frames} == {"2"}
    assert {frame["run_id"] for frame in frames} == {one["run_id"] for one in fish}


def test_each_video_has_one_file_of_each_kind_in_its_partition(folder: Path, tmp_path: Path):
    publish(folder, JOB, tmp_path)
    partition = "vessel=Sea%2FBird/trip=7/clip.parquet"
    assert files(tmp_path) == [f"dataset/{kind}/{partition}" for kind in sorted(TABLE_KINDS)]


def test_publishing_again_changes_no_file(folder: Path, tmp_path: Path):
    publish(folder, JOB, tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}
    publish(folder, JOB, tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")} == before


def test_without_its_recording_a_video_still_takes_verdicts(folder: Path, tmp_path: Path):
    left = Path(shutil.copytree(folder, tmp_path / "left"))
    before = parquet.read_table(left / "fish.parquet").to_pylist()
    for path in (*left.glob("recording.*"), left / "fish.parquet"):
        path.unlink()
    verdict = Verdict(track_id=2, kind="reject", reason="a glove", reviewer="Ada")
    add_verdict(left / "lengths.db", verdict)
    mesh = str(folder.parent / "clip" / "tiny.ply")
    publish(left, replace(JOB, given=OPTIONS | {"template": mesh}), tmp_path)
    after = parquet.read_table(left / "fish.parquet").to_pylist()
    assert [one["verdict"] for one in after] == [None, "reject"]
    of_review = ("verdict", "verdict_reason", "reviewer", "reviewed_utc", "reviewed_ns")
    for one in before + after:
        for name in of_review:
            one.pop(name)
    assert after == before


def test_fish_have_the_haul_that_was_told_since(folder: Path, tmp_path: Path):
    told = Path(shutil.copytree(folder, tmp_path / "told"))
    end_s = float(rows(told / "lengths.csv")[-1]["last_time"])
    write_haul(told, "start", name="9", at="0", said_by="Ada")
    write_haul(told, "end", name="", at=str(end_s + 1), said_by="Ada")
    publish(told, JOB, tmp_path)
    for kind in TABLE_KINDS:
        table = parquet.read_table(told / f"{kind}.parquet").to_pylist()
        assert {row["haul"] for row in table} == {"9"}


def test_files_of_videos_that_are_not_finished_go(folder: Path, tmp_path: Path):
    other = Job(name="other", given={"source": "/videos/other.mp4"})
    publish(folder, JOB, tmp_path)
    publish(folder, other, tmp_path)
    withdraw_others([other], tmp_path)
    assert all("other.parquet" in name for name in files(tmp_path))
    assert len(files(tmp_path)) == len(TABLE_KINDS)
