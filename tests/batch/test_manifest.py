"""The manifest of a batch: which rows are refused, how videos are named, what makes a job new."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.batch.manifest import COLUMNS, Job, read_manifest
from stream_dmr.batch.measure_video import request_of
from stream_dmr.errors import UserError

HEADER = ",".join(COLUMNS) + "\n"


def read(path: Path, text: str) -> list[Job]:
    path.write_text(text, encoding="utf-8")
    return read_manifest(path, config=None, template="cod")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "expected the columns"),
        ("video,calibration\n", "expected the columns"),
        (f"{','.join(COLUMNS)},more\n", "expected the columns"),
        (HEADER, "a row for each video"),
        (f"{HEADER},,,,,,\n", "line 2: expected 7 cells"),
        (f"{HEADER}a.mp4,,,,,,,,\n", "line 2: expected 7 cells"),
    ],
)
def test_a_wrong_manifest_is_refused(tmp_path: Path, text: str, match: str):
    with pytest.raises(UserError, match=match):
        read(tmp_path / "m.csv", text)
    with pytest.raises(UserError, match="expected a manifest"):
        read_manifest(tmp_path / "none.csv", config=None, template="cod")


def test_relative_paths_start_from_the_manifest(tmp_path: Path):
    (job,) = read(tmp_path / "m.csv", f"{HEADER}a.mp4,b.yaml,,/masks,v,t,h\n")
    run = job.options
    assert (run.source, run.calibration) == (str(tmp_path / "a.mp4"), tmp_path / "b.yaml")
    assert (run.boxes, run.masks) == (None, Path("/masks"))
    assert (run.vessel, run.trip, run.haul) == ("v", "t", "h")


def test_positions_and_the_start_of_a_video_may_be_given(tmp_path: Path):
    header = f"{HEADER.strip()},start_utc,nmea\n"
    first, second = read(
        tmp_path / "m.csv", f"{header}a.mp4,,,,,,,2026-11-22T06:00:00Z,way.nmea\nb.mp4,,,,,,,,\n"
    )
    assert first.options.nmea == str(tmp_path / "way.nmea")
    assert first.options.start_utc == "2026-11-22T06:00:00Z"
    assert (second.options.nmea, second.options.start_utc) == (None, "")
    key = first.key
    (tmp_path / "way.nmea").write_text("$GPRMC,1")
    assert first.key != key
    command = request_of(first, tmp_path / "out").command
    assert "--start-utc 2026-11-22T06:00:00Z" in command


@given(st.lists(st.text("aä./-1", min_size=1, max_size=4), min_size=1, max_size=6, unique=True))
def test_names_of_videos_are_unique_folder_names(
    tmp_path_factory: pytest.TempPathFactory, videos: list[str]
):
    folder = tmp_path_factory.getbasetemp()
    names = [
        job.name for job in read(folder / "m.csv", HEADER + "".join(f"{v},,,,,,\n" for v in videos))
    ]
    assert len(set(names)) == len(videos)
    assert all(Path(name).name == name and not name.endswith(".part") for name in names)


def test_videos_of_equal_names_keep_their_folders_when_rows_come_and_go(tmp_path: Path):
    def named(videos: list[str], earlier: dict[str, str]) -> dict[str, str]:
        (tmp_path / "m.csv").write_text(HEADER + "".join(f"{v}/1.mp4,,,,,,\n" for v in videos))
        jobs = read_manifest(tmp_path / "m.csv", config=None, template="cod", earlier=earlier)
        assert len({job.name for job in jobs}) == len(jobs)
        return {job.options.source: job.name for job in jobs}

    def folders(names: dict[str, str]) -> dict[str, str]:
        return {Path(source).parent.name: name for source, name in names.items()}

    first = named(["a", "b"], {})
    assert folders(first) == {"a": "1", "b": "1-2"}
    assert folders(named(["b"], first)) == {"b": "1-2"}
    second = named(["c", "b", "a"], first)
    assert folders(second) == {"c": "1-3", "b": "1-2", "a": "1"}
    assert len(named(["a", "d", "a", "b", "c"], second)) == 4  # a row that is given twice


@pytest.fixture
def job(tmp_path: Path) -> Job:
    names = ("video.mp4", "calibration.yaml", "boxes.txt", "config.toml", "tiny.ply", "tiny.toml")
    for name in names:
        (tmp_path / name).write_text(name)
    options = ("source", "calibration", "boxes", "config", "template")
    files = (str(tmp_path / name) for name in names[:5])
    return Job(name="video", given=dict(zip(options, files, strict=True)))


def test_a_key_is_unchanged_while_all_inputs_are(job: Job):
    assert replace(job).key == job.key


@pytest.mark.parametrize("name", ["video.mp4", "boxes.txt", "config.toml", "tiny.ply", "tiny.toml"])
@pytest.mark.parametrize(
    "change", [lambda path: path.write_text("anything else"), lambda path: path.unlink()]
)
def test_a_changed_file_changes_the_key(
    job: Job, tmp_path: Path, name: str, change: Callable[[Path], object]
):
    before = job.key
    change(tmp_path / name)
    assert job.key != before


@pytest.mark.parametrize("field", ["vessel", "trip", "haul", "masks"])
def test_a_changed_row_changes_the_key(job: Job, field: str):
    assert replace(job, given=job.given | {field: "another"}).key != job.key
