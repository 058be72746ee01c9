"""A replay's output is a run's output: exports, reviews and verify take it as one."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from stream_dmr.calibration.calibration_file import load_calibration, save_calibration
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.messages import FittedMesh
from stream_dmr.pipeline.haul_log import write_haul
from stream_dmr.recording.view_geometry import MeshRebuilder
from stream_dmr.store.effort import read_effort
from stream_dmr.store.fish import read_runs, read_stored_fish, run_notes
from stream_dmr.store.run_facts import SOURCE_ENDED
from stream_dmr.store.schema import WATCHED, read_rows
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.verdict_recorder import SubmittedVerdict, VerdictRecorder
from tests.support.command import invoke, rows
from tests.support.fish_run import measure

FLAG = "the camera seems bumped"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = measure(tmp_path_factory.mktemp("fish"), vessel="Sea Bird", trip="7", haul="b")
    with closing(sqlite3.connect(out / "lengths.db")) as database, database:
        database.execute("UPDATE fish SET flags = ? WHERE track_id = 2", (f'["{FLAG}"]',))
    return out


@pytest.fixture(scope="module")
def again(run: Path) -> Path:
    """The run with another calibration of the same camera."""
    calibration, out = run.parent / "new.yaml", run.parent / "again"
    save_calibration(calibration, load_calibration(run.parent / "clip" / "calibration.yaml"))
    options = {"--from": "localize", "--calibration": str(calibration), "--out": str(out)}
    assert invoke(f"replay {run}", options).code == 0
    return out


def test_it_has_the_fish_of_the_run_with_vessel_trip_haul_and_flags(run: Path, again: Path):
    (facts,) = read_runs(again / "lengths.db").values()
    assert (facts.vessel, facts.trip, facts.haul) == ("Sea Bird", "7", "b")
    assert (facts.ended_by, facts.frames_done, facts.frames_promised) == (SOURCE_ENDED, 6, 6)
    fish, before = (read_stored_fish(out / "lengths.db") for out in (again, run))
    for one, other in zip(fish, before, strict=True):
        assert one.estimate.length_mm == pytest.approx(other.estimate.length_mm)
        assert (one.iou, one.flags) == (other.iou, other.flags)
    assert [one.flags for one in fish] == [[], [FLAG]]


def test_it_has_the_hauls_and_the_effort_of_the_run(run: Path, tmp_path: Path):
    copy, again = Path(shutil.copytree(run, tmp_path / "run")), tmp_path / "again"
    for what, at in (("start", "0"), ("end", "0.25")):
        write_haul(copy, what, name="A", at=at, said_by="Ada")
    assert invoke(f"replay {copy}", {"--from": "smooth", "--out": str(again)}).code == 0
    before, after = (
        read_effort(out / "lengths.db", read_stored_fish(out / "lengths.db"))
        for out in (copy, again)
    )
    assert after == before
    assert {one.haul: one.hours_watched > 0 for one in after}["A"]
    part = tmp_path / "part"
    options = {"--from": "smooth", "--time": "0.1:0.3", "--out": str(part)}
    assert invoke(f"replay {copy}", options).code == 0
    assert 0 < sum(row["frames"] for row in read_rows(part / "lengths.db", WATCHED)) < 6


def test_it_is_verified_exported_and_reviewed(again: Path, tmp_path: Path):
    assert verify(again)[0] == []
    assert invoke("export", {str(again): None, "--fish": "csv", "--out": str(tmp_path)}).code == 0
    assert {row["vessel"] for row in rows(tmp_path / "fish.csv")} == {"Sea Bird"}
    recorder = VerdictRecorder(open_report(again), "Ada")
    recorder.record(SubmittedVerdict(track_id=1, kind="accept"))
    assert [one.review.decision for one in read_stored_fish(again / "lengths.db")] == ["accept", ""]


def test_a_part_says_that_it_is_one(run: Path, tmp_path: Path):
    out = tmp_path / "out"
    assert invoke(f"replay {run}", {"--track": "1", "--out": str(out)}).code == 0
    assert "the selected part of a recording" in run_notes(out)[0]


@pytest.mark.parametrize(("rrd", "are_computed"), [("true", True), ("false", False)])
def test_vertices_are_computed_only_to_be_drawn(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rrd: str, are_computed: bool
):
    computed: list[FittedMesh] = []
    with_vertices = MeshRebuilder.with_vertices

    def counted(meshes: MeshRebuilder, fit: FittedMesh) -> FittedMesh:
        computed.append(fit)
        return with_vertices(meshes, fit)

    monkeypatch.setattr(MeshRebuilder, "with_vertices", counted)
    config = tmp_path / "config.toml"
    config.write_text(f"[recording]\nrrd = {rrd}\n")
    options = {"--from": "localize", "--config": str(config), "--out": str(tmp_path / "out")}
    assert invoke(f"replay {run}", options).code == 0
    assert bool(computed) == are_computed


def test_the_recording_alone_is_replayed_without_them(run: Path, tmp_path: Path):
    (tmp_path / "recording.mcap").write_bytes((run / "recording.mcap").read_bytes())
    out = tmp_path / "out"
    assert invoke(f"replay {tmp_path / 'recording.mcap'}", {"--out": str(out)}).code == 0
    (facts,) = read_runs(out / "lengths.db").values()
    assert facts.vessel == ""


def test_a_damaged_database_does_not_end_it(run: Path, tmp_path: Path):
    (tmp_path / "recording.mcap").write_bytes((run / "recording.mcap").read_bytes())
    (tmp_path / "lengths.db").write_bytes(b"nothing of the kind" * 99)
    outcome = invoke(f"replay {tmp_path}", {"--out": str(tmp_path / "out")})
    assert outcome.code == 0
    assert "are not taken over" in outcome.err


def test_it_is_refused_into_the_folder_of_its_recording(run: Path):
    before = (run / "recording.mcap").read_bytes()
    outcome = invoke(f"replay {run}", {"--out": str(run), "--overwrite": None})
    assert outcome.code == 2
    assert "would be lost" in outcome.error
    assert (run / "recording.mcap").read_bytes() == before
