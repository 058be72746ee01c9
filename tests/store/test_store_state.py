"""What is summed up beside fish, events and runs: all of it, but nothing that a sum changes."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from stream_dmr.store import schema
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.scale_checks import ScaleCheck, add_check
from stream_dmr.store.schema import check_lines, open_for_reading, read_state
from tests.support.final_estimates import FACTS

CHECK = ScaleCheck(
    **{"source": "board.png", "calibration_sha256": "c", "known_mm": 200.0, "error_mm": 10.0},
    **{"error_percent": 5.0, "worst_percent": 5.1, "limit_percent": 1.0},
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with closing(LengthStore(tmp_path, FACTS)) as store:
        store.reserve_track(7)
        store.clip_progress("a.mp4", frames_done=9)
        store.keep_scene(b"rail")
    return tmp_path


def state_of(folder: Path) -> tuple[object, object]:
    with closing(open_for_reading(folder / "lengths.db")) as database:
        return dict(read_state(database)), [*check_lines(database)]


def test_a_run_that_adds_nothing_leaves_it(folder: Path):
    """Though it writes: what counts the statements is not in it."""
    before = state_of(folder)
    LengthStore(folder, FACTS).close()
    assert state_of(folder) == before


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE marks SET value = 8 WHERE name = 'track_id'",
        "UPDATE clips SET frames_done = 8",
        "UPDATE scenes SET data = x'01'",
        "DELETE FROM scenes",
    ],
)
def test_each_change_is_in_it(folder: Path, statement: str):
    before = state_of(folder)
    with closing(sqlite3.connect(folder / "lengths.db")) as database, database:
        assert database.execute(statement).rowcount == 1
    assert state_of(folder) != before


def test_checks_are_lines_that_only_grow(folder: Path):
    lines = list[object]()
    for count in range(3):
        assert state_of(folder)[1] == lines
        add_check(folder / "lengths.db", CHECK)
        more = state_of(folder)[1]
        assert isinstance(more, list)
        assert (more[:count], len(more)) == (lines, count + 1)
        lines = more


def test_on_a_full_disk_it_is_room_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def fill(*_: object, **__: object) -> None:
        with closing(sqlite3.connect(":memory:")) as database:
            database.execute("PRAGMA max_page_count = 1")
            database.execute("CREATE TABLE fish (number)")

    monkeypatch.setattr(schema, "_opened", fill)
    with pytest.raises(schema.DiskRefusal, match="full; make room or choose another --out"):
        schema.open_for_writing(tmp_path / "lengths.db")
