"""`stream-dmr batch`: the same as `run` on each video, whatever is killed in between."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from ast import literal_eval
from collections import Counter
from pathlib import Path
from typing import Any

import pandas
import pytest
from pyarrow import dataset

from stream_dmr.batch.driver import run_batch
from stream_dmr.batch.engines import LocalEngine
from stream_dmr.batch.manifest import COLUMNS, Job, read_manifest
from stream_dmr.batch.measure_video import BatchProgress, measure_video, read_outcome
from stream_dmr.errors import OutputError
from stream_dmr.evidence.seal import seal_verdicts
from stream_dmr.evidence.verify_batch import check_batch
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.store.batch_folder import results_folder
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.scale_checks import ScaleCheck, add_check
from stream_dmr.store.verdicts import Verdict, add_verdict
from tests.support.batch_engine import ThisProcess
from tests.support.command import invoke, rows
from tests.support.fish_run import FISH, request
from tests.support.nmea import START_NS, straight_way
from tests.support.tiny_clip import write_clip

SUPPORT = Path(__file__).resolve().parents[1] / "support"
TABLES = ("lengths.csv", "frames.csv")
COMING_AND_GOING = [
    *([1, 2], [1, 2], [1, 2], [1, 2], [1], [1, 3], [1, 3], [3], [3], [3]),
    *([], [4], [4], [4], [4], [4], [4], [4], [2, 4], [2]),
]


def write_manifest(path: Path, *jobs: dict[str, str]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(jobs)
    return path


def row(clip: str = "clip", **other: str) -> dict[str, str]:
    files = {"video": f"{clip}/video.mp4", "calibration": f"{clip}/calibration.yaml"}
    return (
        files | {"masks": f"{clip}/masks", "vessel": "Sea/Bird", "trip": "7", "haul": "1"} | other
    )


@pytest.fixture(scope="module")
def season(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two clips, the first of them twice, and what `run` makes of it."""
    folder = tmp_path_factory.mktemp("season")
    write_clip(folder / "clip", fish=FISH)
    write_clip(folder / "other", fish=[[1], [1], [1], [1, 3], [3], [3]])
    shutil.copytree(folder / "clip", folder / "again")
    (folder / "broken").mkdir()
    (folder / "broken" / "video.mp4").write_bytes(b"this is no video")
    measure_source(request(folder / "clip", folder / "alone"), stop=threading.Event())
    return folder


def jobs_of(season: Path, tmp_path: Path, *lines: dict[str, str]) -> list[Job]:
    manifest = write_manifest(season / f"{tmp_path.name}.csv", *lines)
    clip = season / "clip"
    return read_manifest(manifest, config=clip / "quick.toml", template=str(clip / "tiny.ply"))


def measure(jobs: list[Job], out: Path) -> dict[str, str]:
    summary = run_batch(jobs, out, ThisProcess(), stop=threading.Event())
    return {one.name: one.status for one in summary.outcomes}


def assert_same_tables(folder: Path, other: Path) -> None:
    for name in TABLES:
        assert (folder / name).read_bytes() == (other / name).read_bytes()


def test_a_batch_measures_a_video_as_run_does(season: Path, tmp_path: Path):
    (job,) = jobs_of(season, tmp_path, row())
    shares = list[float]()
    outcome = measure_video(job, tmp_path, on_progress=shares.append)
    folder = results_folder(job.name, tmp_path)
    assert_same_tables(folder, season / "alone")
    assert (outcome.num_frames, outcome.num_fish) == (len(FISH), 2)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert verify(folder)[0] == []
    assert read_outcome(job, tmp_path) == outcome


@pytest.mark.slow
def test_a_worker_s_video_has_positions_and_its_fish_have_fates(season: Path, tmp_path: Path):
    """The other video is not there, which the command's exit code says."""
    (season / "way.nmea").write_text(straight_way(10), newline="")
    zones = season / "zones.toml"
    whole = "[[0, 0], [160, 0], [160, 120], [0, 120]]"
    zones.write_text(
        (season / "clip" / "quick.toml").read_text() + f"\n[zones]\nlanded = {whole}\n"
    )
    manifest = season / "positions.csv"
    header = ",".join([*COLUMNS, "nmea", "start_utc"])
    cells = [*(row().get(name, "") for name in COLUMNS), "way.nmea", "2026-11-22T06:00:02Z"]
    missing = ["missing.mp4", *("" for _ in cells[1:])]
    manifest.write_text("\n".join([header, ",".join(cells), ",".join(missing), ""]))
    outcome = invoke(
        "batch",
        {str(manifest): None, "--out": str(tmp_path), "--config": str(zones), "--workers": "1"}
        | {"--template": str(season / "clip" / "tiny.ply")},
    )
    assert outcome.code == 2
    assert "1 of 2 videos are done, 0 of them before, 1 failed" in outcome.out
    assert "missing: failed: " in outcome.err
    folder = tmp_path / "videos" / "video"
    fish = read_stored_fish(folder / "lengths.db")
    for one in fish:
        assert one.utc_ns == START_NS + 2_000_000_000 + one.middle_ns
        assert one.where.latitude == pytest.approx(57.0)
    counted = Counter(one.fate for one in fish)
    said = ", ".join(f"{count} {name}" for name, count in counted.most_common())
    assert f"fate: {said}" in outcome.out
    assert json.loads((folder / "outcome.json").read_text())["fates"] == counted
    assert verify(folder)[0] == []


def test_a_bad_video_fails_alone(season: Path, tmp_path: Path):
    lines = row(), row("other", trip="8"), row(video="broken/video.mp4"), row("again", masks="none")
    jobs = jobs_of(season, tmp_path, *lines, row(video="missing.mp4", vessel=""))
    assert [job.name for job in jobs] == ["video", "video-2", "video-3", "video-4", "missing"]
    statuses = measure(jobs, tmp_path / "out")
    assert list(statuses.values()) == ["done", "done", "failed", "failed", "failed"]
    assert_same_tables(results_folder(jobs[0].name, tmp_path / "out"), season / "alone")
    table = rows(tmp_path / "out" / "videos.csv")
    assert [line["status"] for line in table] == list(statuses.values())
    assert "broken" in table[2]["reason"]
    assert "none" in table[3]["reason"]
    assert "missing.mp4" in table[4]["reason"]
    assert not list((tmp_path / "out" / "videos").glob("*.part"))


def test_the_data_set_holds_every_fish_and_every_frame(season: Path, tmp_path: Path):
    jobs = jobs_of(season, tmp_path, row(), row("other", trip="8", haul="2"))
    measure(jobs, tmp_path)
    fish = dataset.dataset(tmp_path / "dataset" / "fish", partitioning="hive").to_table()
    frames = dataset.dataset(tmp_path / "dataset" / "frames", partitioning="hive").to_table()
    for job in jobs:
        folder = results_folder(job.name, tmp_path)
        measured = rows(folder / "lengths.csv")
        found = [one for one in fish.to_pylist() if one["video"] == job.name]
        assert [one["track_id"] for one in found] == [int(one["track_id"]) for one in measured]
        for one, line in zip(found, measured, strict=True):
            assert f"{one['length_mm']:.6f}" == line["length_mm"]
            assert (one["vessel"], str(one["trip"]), one["haul"]) == (
                "Sea/Bird",
                job.options.trip,
                job.options.haul,
            )
            assert one["run_id"]
            assert len(one["config_sha256"]) == 64
        lines = rows(folder / "frames.csv")
        seen = [one for one in frames.to_pylist() if one["video"] == job.name]
        assert len(seen) == len(lines)
        for one, line in zip(seen, lines, strict=True):
            assert (one["frame_index"], one["reason"]) == (int(line["frame_index"]), line["reason"])
            assert one["accepted"] is (line["accepted"] == "true")
            assert one["run_id"] == found[0]["run_id"]


@pytest.fixture(scope="module")
def finished(season: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A batch of three videos: two came without a trip, one shows no fish."""
    folder = tmp_path_factory.mktemp("finished")
    write_clip(season / "sea", fish=[[]] * 3)
    (season / "sea" / "masks" / "000001.png").rename(season / "sea" / "masks" / "000009.png")
    measure(jobs_of(season, folder, row(), row("sea", trip=""), row("again", trip="")), folder)
    return folder


def test_duckdb_opens_the_data_set(finished: Path):
    """In a process of its own: what duckdb leaks is printed at its end."""
    query = "SELECT vessel, trip, count(*) FROM read_parquet('{}', hive_partitioning = true) "
    query += "GROUP BY ALL ORDER BY trip"
    code = "import sys, duckdb; print([duckdb.sql(one).fetchall() for one in sys.argv[1:]])"
    asked = [
        query.format(finished / "dataset" / kind / "**" / "*.parquet")
        for kind in ("fish", "frames")
    ]
    done = subprocess.run(
        [sys.executable, "-c", code, *asked], capture_output=True, text=True, check=True
    )
    assert literal_eval(done.stdout) == [
        [("Sea/Bird", "", count), ("Sea/Bird", "7", count)] for count in (2, 10)
    ]


def test_pandas_opens_the_data_set(finished: Path):
    fish = pandas.read_parquet(finished / "dataset/fish")
    assert set(fish["vessel"]) == {"Sea/Bird"}
    assert sorted(fish["trip"]) == ["", "", "7", "7"]
    lengths = rows(finished / "videos" / "video" / "lengths.csv")
    of_first = fish[fish["video"] == "video"]["length_mm"]
    assert list(of_first.round(6)) == [float(line["length_mm"]) for line in lengths]


def test_an_export_of_a_batch_is_refused_with_the_folders_that_it_can_take(
    finished: Path, tmp_path: Path
):
    refused = invoke(f"export {finished} --fish csv --out {tmp_path / 'exports'}")
    assert refused.code == 2
    assert "got that of a batch; give one of its videos/NAME" in refused.error


def test_verify_finds_a_changed_data_set(season: Path, tmp_path: Path):
    (job,) = jobs_of(season, tmp_path, row())
    measure([job], tmp_path)
    assert verify(tmp_path)[0] == []
    (copy,) = (tmp_path / "dataset" / "fish").rglob("*.parquet")
    copy.write_bytes(copy.read_bytes() + b"x")
    (change,) = verify(tmp_path)[0]
    assert [*check_batch(tmp_path)] == [change[:2]]
    assert change.path == copy
    assert "differs from videos/video/fish.parquet" in change.what
    shutil.copy(tmp_path / "videos" / "video" / "fish.parquet", copy)
    elsewhere = copy.parents[1] / "trip=9" / copy.name
    elsewhere.parent.mkdir()
    copy.rename(elsewhere)  # which makes it another trip's
    assert [(change.path, change.what) for change in verify(tmp_path)[0]] == [
        (copy, "is missing"),
        (elsewhere, "belongs to no finished video of videos.csv"),
    ]


def test_verify_finds_a_changed_table_of_videos(season: Path, tmp_path: Path):
    jobs = jobs_of(season, tmp_path, row(vessel="Sea Bird"), row(video="no/broken.mp4"))
    table = tmp_path / "videos.csv"
    for before, after, expected in (
        (",done,", ",failed,", "video: status is failed, outcome.json says done"),
        ("no such file", "is fine", "broken: reason is "),
        ("Sea Bird", "Other", "is missing"),  # where the data set has that vessel's fish
    ):
        measure(jobs, tmp_path)
        assert verify(tmp_path)[0] == []
        text = table.read_text()
        assert before in text
        table.write_text(text.replace(before, after, 1))
        found = [change.what for change in verify(tmp_path)[0]]
        assert "was changed: its SHA-256 is not that in provenance.json" in found
        assert any(what.startswith(expected) for what in found), found
    measure(jobs, tmp_path)
    assert verify(tmp_path)[0] == []


def test_a_report_shows_all_videos(season: Path, tmp_path: Path):
    jobs = jobs_of(season, tmp_path, row(), row("other"), row(video="no/broken.mp4"))
    measure(jobs, tmp_path)
    target = tmp_path / "report.html"
    outcome = invoke("report", {str(tmp_path): None, "--out": str(target)})
    assert outcome.code == 0, outcome.err
    text = target.read_text()
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text)
    assert found is not None
    shown = json.loads(found[1])
    fish = shown["fish"]
    assert [(one["id"], one["video"], one["track_id"]) for one in fish] == [
        *((1, "video", 1), (2, "video", 2)),
        *((1_000_000_001, "video-2", 1), (1_000_000_003, "video-2", 3)),
    ]
    assert all(f'id="fish-{one["id"]}"' in text for one in fish)
    assert fish[1]["time_s"] < fish[2]["time_s"]  # the second clip's clock begins anew
    assert [line.split(":")[0] for line in shown["notes"]] == ["broken"]
    assert verify(tmp_path)[0] == []  # the report is known there
    measure(jobs, tmp_path)
    target.write_text(text + " ")
    assert [change.path for change in verify(tmp_path)[0]] == [target]


def test_a_video_whose_tables_can_not_be_written_again_is_named(season: Path, tmp_path: Path):
    jobs = jobs_of(season, tmp_path, row(), row("other"))
    measure(jobs, tmp_path)
    folder = results_folder(jobs[0].name, tmp_path)
    add_verdict(folder / "lengths.db", Verdict(track_id=2, kind="accept", reviewer="Ada"))
    (folder / "frames.csv").unlink()
    lines: list[str] = []
    summary = run_batch(jobs, tmp_path, ThisProcess(), stop=threading.Event(), log=lines.append)
    assert (summary.num_before, len(summary.outcomes)) == (2, 2)
    assert [line.partition(": ")[0] for line in lines] == [jobs[0].name]
    tables = dataset.dataset(tmp_path / "dataset" / "fish").to_table().to_pylist()
    assert {one["video"] for one in tables} == {job.name for job in jobs}


def test_a_reviewed_video_is_not_measured_again_by_other_inputs(season: Path, tmp_path: Path):
    lines = [row("clip"), row("other")]
    out, said = tmp_path / "out", list[str]()
    measure(jobs_of(season, tmp_path, *lines), out)
    verdict = Verdict(track_id=2, kind="accept", reviewer="Ada")
    add_verdict(results_folder("video", out) / "lengths.db", verdict)
    moved = jobs_of(season, tmp_path, *(line | {"trip": "8"} for line in lines))
    summary = run_batch(moved, out, ThisProcess(), stop=threading.Event(), log=said.append)
    assert (summary.num_before, [one.status for one in summary.outcomes]) == (1, ["done"] * 2)
    stored = [
        read_stored_fish(results_folder(one, out) / "lengths.db") for one in ("video", "video-2")
    ]
    assert [fish[0].facts.trip for fish in stored] == ["7", "8"]
    [line] = [line for line in said if "verdicts" in line]
    assert "video: its inputs or stream-dmr changed, but reviewers gave verdicts" in line


def test_verdicts_on_one_video_are_not_taken_for_those_on_another(season: Path, tmp_path: Path):
    out = tmp_path / "out"
    measure(jobs_of(season, tmp_path, row("clip")), out)
    verdict = Verdict(track_id=2, kind="accept", reviewer="Ada")
    add_verdict(results_folder("video", out) / "lengths.db", verdict)
    assert measure(jobs_of(season, tmp_path, row("again")), out) == {"video": "done"}  # moved
    with pytest.raises(OutputError, match=r"results of .*other/video.mp4, got those of .*clip/vid"):
        measure(jobs_of(season, tmp_path, row("other")), out)


def test_the_next_call_takes_verdicts_and_checks_into_the_data_set(season: Path, tmp_path: Path):
    (job,) = jobs_of(season, tmp_path, row())
    measure([job], tmp_path)
    database = results_folder(job.name, tmp_path) / "lengths.db"
    add_verdict(database, Verdict(track_id=2, kind="reject", reason="a glove", reviewer="Ada"))
    seal_verdicts(database.parent)
    check = ScaleCheck(
        source="board.png",
        calibration_sha256=read_stored_fish(database)[0].facts.calibration_sha256,
        **{"known_mm": 200.0, "error_mm": 8.0, "error_percent": 4.0},
        **{"worst_percent": 5.0, "limit_percent": 1.0},
    )
    add_check(database, check)
    measure([job], tmp_path)
    fish = dataset.dataset(tmp_path / "dataset" / "fish").to_table().to_pylist()
    assert [one["verdict"] for one in fish] == [None, "reject"]
    assert [one["scale_error_percent"] for one in fish] == [4.0, 4.0]
    assert verify(tmp_path)[0] == []


def test_finished_videos_are_skipped(season: Path, tmp_path: Path):
    jobs = jobs_of(season, tmp_path, row(), row("other"), row(video="broken/video.mp4"))
    measure(jobs, tmp_path)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.glob("videos/*/recording.mcap")}
    summary = run_batch(jobs, tmp_path, ThisProcess(), stop=threading.Event())
    assert summary.num_before == 2
    assert {p: p.stat().st_mtime_ns for p in tmp_path.glob("videos/*/recording.mcap")} == before
    assert [one.status for one in summary.outcomes] == ["done", "done", "failed"]


def test_a_changed_trip_is_measured_again_and_replaces_the_old_row(season: Path, tmp_path: Path):
    measure(jobs_of(season, tmp_path, row()), tmp_path)
    (job,) = jobs_of(season, tmp_path, row(trip="9"))
    assert read_outcome(job, tmp_path) is None
    measure([job], tmp_path)
    files = list((tmp_path / "dataset" / "fish").rglob("*.parquet"))
    assert [path.parent.name for path in files] == ["trip=9"]  # the old row is gone


def test_a_failure_keeps_the_results_of_an_earlier_call(season: Path, tmp_path: Path):
    shutil.copytree(season / "other", season / "disk")
    jobs = jobs_of(season, tmp_path, row("disk"))
    assert measure(jobs, tmp_path) == {"video": "done"}
    before = (tmp_path / "videos" / "video" / "lengths.csv").read_bytes()
    (season / "disk").rename(season / "not-mounted")
    assert measure(jobs, tmp_path) == {"video": "failed"}
    assert (tmp_path / "videos" / "video" / "lengths.csv").read_bytes() == before
    assert list(tmp_path.glob("dataset/**/*.parquet")) == []  # which has finished videos alone
    assert verify(tmp_path)[0] == []
    (season / "not-mounted").rename(season / "disk")
    assert run_batch(jobs, tmp_path, ThisProcess(), stop=threading.Event()).num_before == 1
    assert verify(tmp_path)[0] == []


@pytest.mark.parametrize("name", ["video", "video.part"])
def test_a_folder_with_files_of_the_user_is_never_replaced(season: Path, tmp_path: Path, name: str):
    picture = tmp_path / "videos" / name / "000001.png"
    picture.parent.mkdir(parents=True)
    picture.write_bytes(b"mine")
    with pytest.raises(OutputError, match="a folder that the batch made"):
        measure(jobs_of(season, tmp_path, row()), tmp_path)
    assert picture.read_bytes() == b"mine"


def test_the_folder_of_a_run_takes_no_batch(season: Path, tmp_path: Path):
    with pytest.raises(OutputError, match=r"lengths\.db of a run"):
        measure(jobs_of(season, tmp_path, row("broken")), season / "alone")
    assert not (season / "alone" / "videos").exists()


def test_only_tables_of_the_data_set_are_removed_from_it(season: Path, tmp_path: Path):
    picture = tmp_path / "dataset" / "frames" / "000001.png"
    picture.parent.mkdir(parents=True)
    picture.write_bytes(b"mine")
    old = tmp_path / "dataset" / "fish" / "vessel=A" / "trip=1" / "old.parquet"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"of a video that is no longer in the manifest")
    measure(jobs_of(season, tmp_path, row("broken")), tmp_path)
    assert picture.exists()
    assert not old.exists()


def test_a_damaged_outcome_counts_as_none(season: Path, tmp_path: Path):
    (job,) = jobs_of(season, tmp_path, row())
    folder = results_folder(job.name, tmp_path)
    for content in ("", "{", "{}", '{"name": "video"}'):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "outcome.json").write_text(content)
        assert read_outcome(job, tmp_path) is None


@pytest.mark.slow  # four starts
def test_a_killed_worker_or_batch_loses_no_finished_video(season: Path, tmp_path: Path):
    """First its worker is killed, which one video is charged with, then the batch itself."""
    clip, out = season / "clip", tmp_path / "out"
    manifest = write_manifest(season / f"{tmp_path.name}.csv", row(), row("other"), row("again"))
    command = [sys.executable, "-m", "stream_dmr.cli.main", "batch", str(manifest)]
    command += ["--config", str(clip / "quick.toml"), "--template", str(clip / "tiny.ply")]
    command += ["--workers", "1", "--out", str(out)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        wait_for(lambda: (out / "videos" / "video.part" / "recording.mcap.part").exists())
        os.kill(workers(out)[0], signal.SIGKILL)
        wait_for(lambda: (out / "videos" / "video-3.part" / "recording.mcap.part").exists())
        process.send_signal(signal.SIGKILL)
    wait_for(lambda: not workers(out))  # nobody goes on unattended
    lines = {line["name"]: line for line in rows(out / "videos.csv")}
    assert "its process ended (-9)" in lines["video"]["reason"]
    assert [line["status"] for line in lines.values()] == ["failed", "done", "waiting"]
    done = out / "videos" / "video-2" / "recording.mcap"
    before = done.stat().st_mtime_ns
    assert not (out / "videos" / "video-3").exists()
    jobs = jobs_of(season, tmp_path, row(), row("other"), row("again"))
    statuses = measure(jobs, out)
    assert list(statuses.values()) == ["done"] * 3
    assert done.stat().st_mtime_ns == before
    for name in ("video", "video-3"):
        assert_same_tables(out / "videos" / name, season / "alone")


def test_less_than_no_worker_is_refused(tmp_path: Path):
    manifest = str(write_manifest(tmp_path / "season.csv", row()))
    options = {"--out": str(tmp_path / "out"), "--workers": "-2"}
    outcome = invoke("batch", {manifest: None} | options)
    assert outcome.code == 2
    assert "--workers" in outcome.err
    assert not (tmp_path / "out").exists()


def workers(out: Path) -> list[int]:
    """Processes that measure into `out`."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"stream_dmr.batch.engines" in words and str(out).encode() in words:
            found.append(int(folder.name))
    return found


def wait_for(condition, seconds: float = 300.0) -> None:  # type: ignore[no-untyped-def]
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.mark.slow  # two starts
def test_a_process_measures_so_many_videos(season: Path, tmp_path: Path):
    """What a process keeps of its videos must not add up over a season."""
    names = ("one.mp4", "two.mp4", "three.mp4")  # none is there, which takes no time to say
    jobs = jobs_of(season, tmp_path, *(row(video=name) for name in names))
    seen = set[int]()

    class Watching(BatchProgress):
        def update(self) -> None:
            seen.update(workers(tmp_path))

    engine = LocalEngine(1, videos_a_process=2)
    progress = Watching(jobs, print)
    outcomes = engine.outcomes(jobs, tmp_path, stop=threading.Event(), progress=progress)
    assert sorted(outcome.name for outcome in outcomes) == ["one", "three", "two"]
    assert len(seen) == 2


def test_processes_share_the_folder_of_compiled_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Without a cache that can be written to, each had compiled all for itself, a minute long."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("stream_dmr.compiled._cache_folder", lambda: tmp_path / "own")
    given, real = list[str](), subprocess.Popen

    def start(command: list[str], **options: Any) -> "subprocess.Popen[str]":
        given.append(options["env"].get("NUMBA_CACHE_DIR"))
        return real([sys.executable, "-c", ""], **options)

    monkeypatch.setattr("stream_dmr.batch.engines.subprocess.Popen", start)
    job = Job(name="1", given={"source": str(tmp_path / "1.mp4")})
    progress = BatchProgress([job], lambda line: None)
    list(LocalEngine(1).outcomes([job], tmp_path, stop=threading.Event(), progress=progress))
    assert given == [str(tmp_path / "own")]


def test_a_stopped_batch_leaves_nothing_unfinished(season: Path, tmp_path: Path):
    jobs = jobs_of(season, tmp_path, row(), row("other"))
    stop = threading.Event()
    stop.set()
    summary = run_batch(jobs, tmp_path, LocalEngine(1), stop=stop)
    assert summary.outcomes == []
    assert shutil.disk_usage(tmp_path).free > 0
    assert [line["status"] for line in rows(tmp_path / "videos.csv")] == ["waiting"] * 2


@pytest.mark.slow  # a dozen starts and more
@pytest.mark.parametrize("seed", [1, 2])
def test_a_batch_killed_at_random_moments_finishes_in_the_end(tmp_path: Path, seed: int):
    clip = tmp_path / "clip"
    write_clip(clip, fish=COMING_AND_GOING)
    write_clip(tmp_path / "other", fish=[[1], [1], [1]])
    measure_source(request(clip, tmp_path / "alone"), stop=threading.Event())
    manifest = write_manifest(tmp_path / "m.csv", row(), row("other"))
    script = SUPPORT / "killed_batch.py"
    command = [sys.executable, str(script), str(manifest), str(clip / "quick.toml")]
    command += [str(clip / "tiny.ply"), str(tmp_path / "out"), str(seed)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout.split()[0]) > 2
    assert_same_tables(tmp_path / "out" / "videos" / "video", tmp_path / "alone")
    assert verify(tmp_path / "out")[0] == []
    assert [line["status"] for line in rows(tmp_path / "out" / "videos.csv")] == ["done"] * 2


@pytest.mark.slow  # a cluster takes a minute to start
def test_ray_measures_all_videos_though_a_worker_dies(season: Path, tmp_path: Path):
    pytest.importorskip("ray", reason="needs Ray: pip install 'stream-dmr[ray]'")
    clip, out = season / "clip", tmp_path / "out"
    lines = row(), row("other"), row(video="broken/video.mp4"), row("again")
    manifest = write_manifest(season / f"{tmp_path.name}.csv", *lines)
    script = SUPPORT / "ray_cluster.py"
    command = [sys.executable, str(script), str(manifest), str(clip / "quick.toml")]
    ended = subprocess.run(
        [*command, str(clip / "tiny.ply"), str(out)], capture_output=True, text=True, check=False
    )
    assert "nodes 2, killed 1, done 3" in ended.stdout, ended.stdout + ended.stderr
    statuses = [line["status"] for line in rows(out / "videos.csv")]
    assert statuses == ["done", "done", "failed", "done"]
    for name in ("video", "video-4"):
        assert_same_tables(out / "videos" / name, season / "alone")
