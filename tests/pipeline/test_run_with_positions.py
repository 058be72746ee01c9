"""A run with positions: recorded, stored, replayed from the recording alone, and sealed."""

import csv
import shutil
import sqlite3
import threading
from pathlib import Path

import pytest

from stream_dmr.evidence.verify_folder import verify
from stream_dmr.messages import Position
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.replay_recording import replay
from stream_dmr.pipeline.run_options import ReplayOptions
from stream_dmr.recording.reading import decoded_messages, open_recordings
from stream_dmr.store.fish import read_fish, read_stored_fish
from stream_dmr.store.trip import read_positions
from stream_dmr.tables import utc_text
from tests.support.command import invoke
from tests.support.fish_run import measure, request
from tests.support.nmea import START_NS, straight_way


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 0.6 s that begins 2.3 s after the first of ten positions, one a second."""
    folder = tmp_path_factory.mktemp("trip")
    measure(folder)
    shutil.rmtree(folder / "out")
    (folder / "way.nmea").write_text("$GPRMC,1\n" + straight_way(10), newline="")
    config = folder / "clip" / "quick.toml"
    sensors = '\n[sensors]\nstart_utc = "2026-11-22T06:00:00Z"\noffset_s = 2.3\nkeep_s = 0.0\n'
    config.write_text(config.read_text() + sensors)
    asked = request(folder / "clip", folder / "out", nmea=str(folder / "way.nmea"))
    measure_source(asked, stop=threading.Event())
    return folder


def positions_in(recording: Path) -> list[Position]:
    found = decoded_messages(open_recordings([recording]), [Position])
    return [message for message, _ in found if isinstance(message, Position)]


def test_the_recording_has_the_positions_around_the_frames(folder: Path):
    times = [position.timestamp_ns for position in positions_in(folder / "out")]
    assert times == [-300_000_000, 700_000_000]
    rrd = folder / "out" / "recording.rrd"
    assert [p.timestamp_ns for p in positions_in(rrd)] == times


def test_each_fish_has_its_place_and_time(folder: Path):
    out = folder / "out"
    for one in read_stored_fish(out / "lengths.db"):
        since_start_ns = 2_300_000_000 + one.middle_ns
        assert one.utc_ns == START_NS + since_start_ns
        assert one.where.longitude == pytest.approx(-152 + since_start_ns * 1e-14, abs=1e-9)
    assert (
        invoke("export", {"--out": str(folder / "exp"), "--fish": "csv", str(out): None}).code == 0
    )
    with (folder / "exp" / "fish.csv").open() as file:
        rows = list(csv.DictReader(file))
    fish = read_stored_fish(out / "lengths.db")
    assert [row["time_utc"] for row in rows] == [utc_text(one.utc_ns) for one in fish]
    assert all(float(row["latitude"]) == pytest.approx(57.0) for row in rows)


def test_a_replay_has_the_positions_of_the_recording(folder: Path):
    (folder / "way.nmea").rename(folder / "gone.nmea")
    asked = ReplayOptions(recordings=[folder / "out"], first="fit", out=folder / "again")
    replay(asked, stop=threading.Event())
    (folder / "gone.nmea").rename(folder / "way.nmea")
    before, after = (read_positions(folder / name / "lengths.db") for name in ("out", "again"))
    assert after == before
    assert positions_in(folder / "again" / "recording.mcap")
    places = [
        [one.where for one in read_stored_fish(folder / n / "lengths.db")] for n in ("out", "again")
    ]
    assert places[0] == places[1]


def test_a_recording_without_its_database_has_them_too(folder: Path, tmp_path: Path):
    recording = tmp_path / "recording.mcap"
    shutil.copyfile(folder / "out" / "recording.mcap", recording)
    fish = read_fish(recording, open_recordings([recording]))
    stored = read_stored_fish(folder / "out" / "lengths.db")
    assert [one.where for one in fish] == [one.where for one in stored]


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE positions SET latitude = 58 WHERE number = 1",
        "DELETE FROM positions WHERE number = 2",
        "DROP TABLE positions",
        "INSERT INTO positions SELECT number + 9, run_id, timestamp_ns + 5, utc_ns, latitude, "
        "longitude, speed_knots, course_deg, is_joined, written_ns FROM positions WHERE number = 2",
    ],
)
def test_changed_positions_are_found(folder: Path, tmp_path: Path, statement: str):
    out = shutil.copytree(folder / "out", tmp_path / "out")
    assert verify(out)[0] == []
    with sqlite3.connect(out / "lengths.db") as database:
        database.execute(statement)
    database.close()
    (change,) = verify(out)[0]
    assert "positions" in change.what


def test_hauls_are_told_to_the_folder_and_sealed(folder: Path, tmp_path: Path):
    out = shutil.copytree(folder / "out", tmp_path / "out")
    for what, at in (("start", "0.1"), ("end", "2026-11-22T06:00:02.7Z")):
        told = invoke("haul", {what: None, str(out): None, "--at": at})
        assert told.code == 0, told.err
    assert [one.haul for one in read_stored_fish(out / "lengths.db")] == ["1", "1"]
    assert verify(out)[0] == []
    with sqlite3.connect(out / "lengths.db") as database:
        database.execute("UPDATE hauls SET timestamp_ns = 5 WHERE number = 1")
    database.close()
    assert [change.what for change in verify(out)[0]] == ["the hauls are not those that were told"]
