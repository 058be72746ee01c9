"""lengths.db: what is in it after whatever happened, and what it refuses."""

import os
import resource
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.errors import OutputError
from stream_dmr.evidence.seal import sealed
from stream_dmr.store.fish import read_runs, read_stored_fish
from stream_dmr.store.ledger import ChainEntry
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.run_facts import RunFacts
from stream_dmr.store.run_tables import lengths_row
from stream_dmr.store.scale_checks import ScaleCheck
from stream_dmr.store.schema import (
    ADDED_FRAMES,
    CHECKS,
    HAULS,
    LEDGER,
    POSITIONS,
    RUNS,
    VERDICTS,
    WATCHED,
    Table,
    open_for_reading,
    open_for_writing,
    read_rows,
)
from stream_dmr.store.trip import KeptPosition
from stream_dmr.store.verdicts import AddedFrame, Verdict, add_verdict, read_verdicts
from tests.support.final_estimates import FACTS, fish
from tests.support.small_disk import fill, small_disk


@pytest.fixture
def store(tmp_path: Path) -> Iterator[LengthStore]:
    opened = LengthStore(tmp_path, FACTS)
    yield opened
    opened.close()


def test_a_file_that_never_got_its_tables_is_refused_in_one_line(tmp_path: Path):
    """The disk failed right after the file was made; a run that ends then has nothing to sum up."""
    with closing(sqlite3.connect(tmp_path / "lengths.db")) as database:
        database.execute("PRAGMA application_id = 1")
    with pytest.raises(OutputError, match="it has no tables"):
        open_for_reading(tmp_path / "lengths.db")
    said = list[str]()
    with sealed(tmp_path, with_recordings=True, on_notice=said.append):
        pass
    assert len(said) == 1
    LengthStore(tmp_path, FACTS).close()  # the next run makes them
    assert len(read_runs(tmp_path / "lengths.db")) == 1


lengths = st.floats(1e-3, 1e6)
times = st.integers(-(2**63), 2**63 - 1)


@settings(max_examples=25)  # each waits for the disk
@given(
    st.lists(st.tuples(st.none() | lengths, times, st.text(max_size=9)), max_size=4), st.booleans()
)
def test_what_is_read_back_gives_the_same_rows(tmp_path_factory, entries, again: bool):
    folder = tmp_path_factory.mktemp("store")
    written = [
        fish(number, length_mm=length_mm, last_timestamp_ns=time_ns, refused={reason: number})
        for number, (length_mm, time_ns, reason) in enumerate(entries, start=1)
    ]
    store = LengthStore(folder, FACTS)
    for estimate in written:
        store.add(estimate, flags=["the camera moved"])
    if again:
        store.close()
        store = LengthStore(folder, FACTS)
    read, last = store.estimates(), store.estimates(last=2)
    assert {e.track_id: store.flags_of(e.track_id) for e in read} == store.flags()
    store.close()
    assert [lengths_row(e) for e in read] == [lengths_row(e) for e in written]
    assert [lengths_row(e) for e in last] == [lengths_row(e) for e in written[-2:]]
    assert [e.refused for e in read] == [e.refused for e in written]


def test_a_row_says_what_made_it(store: LengthStore):
    store.add(fish(1), flags=["the camera moved"])
    reader = sqlite3.connect(store.path)  # while the run is going on
    query = (
        "SELECT track_id, length_mm, flags, refused, software_version, config_sha256, "
        "calibration_sha256, template_sha256, ended_ns FROM fish JOIN runs USING (run_id)"
    )
    assert reader.execute(query).fetchall() == [
        (1, 800.0, '["the camera moved"]', '{"outlier": 2}', "1", "a", "b", "c", None)
    ]
    assert reader.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    store.note("camera", "moved by 4 px", timestamp_ns=7)
    store.close()
    assert reader.execute("SELECT kind, text, timestamp_ns FROM events").fetchall() == [
        ("camera", "moved by 4 px", 7)
    ]
    assert reader.execute("SELECT ended_ns > started_ns FROM runs").fetchone() == (1,)
    reader.close()


def test_a_database_from_before_a_column_is_read_and_gone_on_with(store: LengthStore):
    store.add(fish(1))
    store.close()
    with closing(sqlite3.connect(store.path)) as database:
        for name in ("source_path", "masks_path", "calibration_path", "ended_by"):
            database.execute(f"ALTER TABLE runs DROP COLUMN {name}")
    assert list(read_runs(store.path).values()) == [FACTS]
    facts = replace(FACTS, source_path="/clips/clip.mp4")
    again = LengthStore(store.path.parent, facts)
    again.end("a test")
    again.close()
    assert list(read_runs(store.path).values()) == [FACTS, replace(facts, ended_by="a test")]


def test_runs_are_in_the_order_in_which_they_began_whatever_the_clock_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name, now_ns in (("first", 3), ("second", 1), ("third", 2)):
        monkeypatch.setattr("time.time_ns", lambda now_ns=now_ns: now_ns)
        LengthStore(tmp_path, replace(FACTS, command=name)).close()
    found = read_runs(tmp_path / "lengths.db")
    assert [facts.command for facts in found.values()] == ["first", "second", "third"]


def test_a_database_of_the_first_tables_is_read_and_gone_on_with(store: LengthStore):
    store.add(fish(1))
    store.close()
    with closing(sqlite3.connect(store.path)) as database:
        for table in (HAULS, WATCHED, POSITIONS, CHECKS, VERDICTS, ADDED_FRAMES, LEDGER):
            database.execute(f"DROP TABLE {table.name}")
    (before,) = read_stored_fish(store.path)
    assert (read_rows(store.path, HAULS), read_verdicts(store.path)) == ([], [])
    add_verdict(store.path, Verdict(track_id=1, kind="reject", reviewer="Ada", reason="bent"))
    (after,) = read_stored_fish(store.path)
    assert (before.counts, after.counts) == (True, False)


@pytest.mark.parametrize(
    ("table", "kind"),
    [
        *((RUNS, RunFacts), (CHECKS, ScaleCheck), (VERDICTS, Verdict), (LEDGER, ChainEntry)),
        *((ADDED_FRAMES, AddedFrame), (POSITIONS, KeptPosition)),
    ],
)
def test_fields_are_columns(table: Table, kind: type):
    assert {field.name for field in fields(kind)} <= table.columns.keys()


def test_one_file_is_left(store: LengthStore):
    store.add(fish(1))
    store.close()
    assert [path.name for path in store.path.parent.iterdir()] == ["lengths.db"]


@settings(max_examples=25)  # each waits for the disk
@given(st.lists(st.lists(st.integers(1, 50), max_size=5), min_size=1, max_size=4))
def test_what_was_handed_out_is_not_handed_out_again(tmp_path_factory, runs: list[list[int]]):
    folder, used = tmp_path_factory.mktemp("store"), [0]
    for ids in runs:
        store = LengthStore(folder, FACTS)
        assert store.before.track_id == max(used)
        for number in ids:
            used.append(store.before.track_id + number)
            store.reserve_track(used[-1])
        store.close()


@pytest.mark.parametrize("is_ended", [False, True])
def test_frame_numbers_and_times_go_on(store: LengthStore, is_ended: bool):
    for index in range(1, 4):
        store.frame_passed(frame_index=index, timestamp_ns=10**18 + index)
    if is_ended:
        store.end("the end of the source")
    store.close()
    after = LengthStore(store.path.parent, FACTS)
    assert after.before.frame_index >= 3
    assert after.before.timestamp_ns >= 10**18 + (3 if is_ended else 0)
    after.close()


def test_a_second_run_in_the_same_folder_is_refused(store: LengthStore):
    with pytest.raises(OutputError, match="another run is writing"):
        LengthStore(store.path.parent, FACTS)


def spoil_version(path: Path) -> None:
    database = sqlite3.connect(path)
    database.execute("PRAGMA user_version = 99")
    database.close()


def spoil_bytes(path: Path) -> None:
    path.write_bytes(b"not a database, " * 400)


def spoil_page(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:100] + b"\xff" * 4000 + data[4100:])


@pytest.mark.parametrize("spoil", [spoil_version, spoil_bytes, spoil_page])
def test_a_file_that_can_not_be_trusted_is_refused_and_left_as_it_is(tmp_path: Path, spoil):
    store = LengthStore(tmp_path, FACTS)
    store.close()
    spoil(store.path)
    before = store.path.read_bytes()
    with pytest.raises(OutputError, match=r"lengths\.db: expected .*; "):
        LengthStore(tmp_path, FACTS)
    assert store.path.read_bytes() == before
    with pytest.raises(OutputError, match="upgrade" if spoil is spoil_version else "damaged") as e:
        read_stored_fish(store.path)
    assert "--out" not in str(e.value)


def test_fish_without_their_run_are_refused_in_words(tmp_path: Path):
    with closing(LengthStore(tmp_path, FACTS)) as store:
        store.add(fish(1))
    with closing(sqlite3.connect(store.path)) as database, database:
        database.execute("DELETE FROM runs")
    with pytest.raises(OutputError, match=r"the runs of its fish .* found none of"):
        read_stored_fish(store.path)


WRITER = """
import sys
from pathlib import Path
sys.path[:0] = [{tests!r}]
from stream_dmr.store.length_store import LengthStore
from tests.support.final_estimates import FACTS, fish
store = LengthStore(Path(sys.argv[1]), FACTS)
for number in range(store.before.track_id + 1, 10**6):
    store.reserve_track(number)
    print("begun", number, flush=True)
    store.add(fish(number))
    print("ended", number, flush=True)
"""


def test_killed_at_any_moment_no_fish_is_lost_and_no_id_used_twice(tmp_path: Path):
    program = WRITER.format(tests=str(Path(__file__).parents[2]))
    begun: list[int] = []
    ended: list[int] = []
    for patience in (2, 7, 16):
        command = [sys.executable, "-c", program, str(tmp_path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            lines = [process.stdout.readline() for _ in range(patience)]
            process.send_signal(signal.SIGKILL)
            lines += process.stdout.readlines()
        said = [line.split() for line in lines if line.endswith("\n")]
        now = [int(number) for word, number in said if word == "begun"]
        assert not set(now) & set(begun)
        begun += now
        ended += [int(number) for word, number in said if word == "ended"]
    store = LengthStore(tmp_path, FACTS)
    kept = [estimate.track_id for estimate in store.estimates()]
    store.close()
    assert set(ended) <= set(kept) <= set(begun)
    assert kept == sorted(kept)


def test_a_full_disk_keeps_fish_in_memory_until_there_is_room(tmp_path: Path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    store = LengthStore(tmp_path, FACTS)
    store.add(fish(1))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        for number in range(2, 60):
            store.add(fish(number))
        assert store.trouble
        assert not (tmp_path / "lengths.reserve").exists()  # given up for the lengths
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    store.add(fish(60))
    assert not store.trouble
    assert [estimate.track_id for estimate in store.estimates()] == list(range(1, 61))
    store.close()


def test_a_disk_that_is_full_at_the_start_is_waited_for_and_no_id_is_used_twice(tmp_path: Path):
    with small_disk(tmp_path / "disk", kilobytes=600) as disk:
        store = LengthStore(disk, FACTS)
        store.reserve_track(7)
        store.add(fish(7))
        store.close()
        ballast = fill(disk)
        with pytest.raises(OutputError, match="expected a database of lengths"):
            LengthStore(disk, FACTS)
        store = LengthStore(disk, FACTS, waits_for_disk=True)
        assert store.trouble
        assert store.before.track_id == 7
        assert [estimate.track_id for estimate in store.estimates()] == [7]
        for number in (8, 9):
            store.reserve_track(number)
            store.add(fish(number))
        assert store.trouble
        ballast.unlink()
        store.add(fish(10))
        assert not store.trouble
        assert [estimate.track_id for estimate in store.estimates()] == [7, 8, 9, 10]
        store.close()


def test_a_disk_that_is_full_from_the_very_first_start_is_waited_for(tmp_path: Path):
    with small_disk(tmp_path / "disk", kilobytes=600) as disk:
        ballast = fill(disk)
        store = LengthStore(disk, FACTS, waits_for_disk=True)
        store.add(fish(1))
        assert store.trouble
        ballast.unlink()
        store.add(fish(2))
        store.close()
        store = LengthStore(disk, FACTS)
        assert [estimate.track_id for estimate in store.estimates()] == [1, 2]
        store.close()


class LateError(sqlite3.Connection):
    """A connection whose next COMMIT is done, and then reports an error, as a failed fsync does."""

    is_armed = False

    def execute(self, statement: str, *values: Any) -> sqlite3.Cursor:
        cursor = super().execute(statement, *values)
        if statement == "COMMIT" and self.is_armed:
            self.is_armed = False
            raise sqlite3.OperationalError("disk I/O error")
        return cursor


def test_a_commit_that_failed_and_yet_came_to_be_is_not_written_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    opened = list[LateError]()

    def open_late(path: Path) -> LateError:
        open_for_writing(path).close()
        opened.append(LateError(path, isolation_level=None, check_same_thread=False))
        return opened[-1]

    monkeypatch.setattr("stream_dmr.store.length_store.open_for_writing", open_late)
    store = LengthStore(tmp_path, FACTS)
    opened[0].is_armed = True
    store.note("camera", "moved by 4 px", timestamp_ns=7)
    store.add(fish(1))
    assert len(opened) == 2
    assert not store.trouble
    store.close()
    with closing(open_for_reading(store.path)) as database:
        assert database.execute("SELECT count(*) FROM events").fetchone() == (1,)


def test_fish_that_never_got_to_the_disk_are_not_passed_over(tmp_path: Path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    store = LengthStore(tmp_path, FACTS)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1, hard))
    try:
        store.add(fish(1))
        with pytest.raises(OutputError, match=r"expected room.* copy of lengths\.csv"):
            store.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_the_reserve_leaves_a_small_disk_its_room(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    reserve = tmp_path / "lengths.reserve"
    free = os.statvfs(tmp_path)
    assert reserve.stat().st_size <= min(1 << 20, free.f_bavail * free.f_frsize // 50)
    store.close()
    assert not reserve.exists()
