"""Rows of a lengths.db that wait until the disk takes them."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from stream_dmr.errors import OutputError
from stream_dmr.files import ReservedSpace
from stream_dmr.store.length_store import WaitingRows
from stream_dmr.store.schema import MARK, NAME


def mark(name: str, value: int) -> tuple[str, tuple[object, ...]]:
    return MARK, (name, value)


def marks_of(path: Path) -> dict[str, int]:
    with closing(sqlite3.connect(path)) as database:
        return dict(database.execute("SELECT name, value FROM marks"))


def test_every_commit_writes_what_is_so_at_that_moment(tmp_path: Path):
    now = {"frame_index": 0}
    rows = WaitingRows(
        tmp_path / NAME,
        ReservedSpace(tmp_path),
        waits_for_disk=False,
        state=lambda: [mark(name, value) for name, value in now.items()],
    )
    rows.pending.append(mark("a", 1))
    now["frame_index"] = 7
    rows.write(mark("b", 2))
    rows.close()
    assert marks_of(tmp_path / NAME) == {"a": 1, "b": 2, "frame_index": 7, "written": 2}


def test_rows_wait_in_their_order_for_a_disk_that_is_away(tmp_path: Path):
    path = tmp_path / "away" / NAME
    reserve = ReservedSpace(tmp_path)
    with pytest.raises(OutputError):
        WaitingRows(path, reserve, waits_for_disk=False, state=list)
    rows = WaitingRows(path, reserve, waits_for_disk=True, state=list)
    rows.write(mark("a", 1))
    rows.write(mark("a", 2))
    assert rows.trouble
    assert rows.pending == [mark("a", 1), mark("a", 2)]
    (tmp_path / "away").mkdir()
    rows.write()
    assert (rows.trouble, rows.pending) == ("", [])
    rows.close()
    assert marks_of(path) == {"a": 2, "written": 2}
