"""The tables of lengths.db that reviewers write to; rows are only added."""

import json
import sqlite3
import time
from collections.abc import Generator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, fields, replace
from hashlib import sha256
from pathlib import Path

from stream_dmr.errors import OutputError, UserError
from stream_dmr.results.lengths_database import DiskRefusal, open_for_reading, open_for_writing
from stream_dmr.results.sql import (
    add_columns,
    columns_of,
    has_table,
    insertion,
    rows_of,
    transaction,
)
from stream_dmr.results.store_state import REVIEWED_ID
from stream_dmr.results.verdicts import Verdict

_ADDED_COLUMNS = {
    **dict.fromkeys(("undoes", "other_fish"), "INTEGER"),
    **dict.fromkeys(("fish", "frames_sha256", "reading", "fate", "condition"), "TEXT"),
}
_TABLES = """
CREATE TABLE IF NOT EXISTS verdicts (
    number INTEGER PRIMARY KEY,
    track_id INTEGER NOT NULL,
    kind TEXT NOT NULL,
    reason TEXT NOT NULL, -- of a rejection
    species TEXT NOT NULL,
    duplicate_of INTEGER, -- track id
    frame_index INTEGER, -- of a correction: where its points were set; of a split: the first after
    head_u REAL, head_v REAL, tail_u REAL, tail_v REAL, -- of a correction, frame pixels
    length_mm REAL, length_std_mm REAL, -- of all frames that are corrected so far
    reviewer TEXT NOT NULL,
    written_ns INTEGER NOT NULL -- wall clock
) STRICT;
CREATE TABLE IF NOT EXISTS added_frames (
    track_id INTEGER NOT NULL, frame_index INTEGER NOT NULL,
    crop BLOB NOT NULL, fit BLOB NOT NULL, fish BLOB NOT NULL, -- messages, encoded as recorded
    PRIMARY KEY (track_id, frame_index)
) STRICT;
"""
_USED = (
    f"INSERT INTO marks VALUES ('{REVIEWED_ID}', ?1) ON CONFLICT (name) DO UPDATE SET value = ?1"
)


@dataclass(frozen=True, kw_only=True)
class AddedFrame:
    """One frame of a fish that a reviewer added; its messages encoded as in a recording."""

    track_id: int
    frame_index: int
    crop: bytes
    fit: bytes
    fish: bytes


def frames_sha256(frames: Sequence[AddedFrame]) -> str:
    """SHA-256 of added frames, for the verdict that adds them."""
    return sha256(repr([tuple(asdict(frame).values()) for frame in frames]).encode()).hexdigest()


def add_verdict(
    path: Path,
    verdict: Verdict,
    *,
    frames: Sequence[AddedFrame] = (),
    new_fish: int | None = None,
    known: int | None = None,
) -> Verdict:
    """Write a verdict into a lengths.db, durably; returns it with its time.

    `frames` are those of an added fish, `new_fish` is a track id that it uses. With `known`, the
    number of verdicts that it builds on, UserError where another reviewer has written meanwhile.
    Raises OutputError where the disk refuses it.
    """
    verdict = replace(verdict, written_ns=time.time_ns())
    with _refusing(path), closing(_open_for_verdicts(path)) as database:
        _prepare(database)
        with transaction(database):
            (count,) = database.execute("SELECT COUNT(*) FROM verdicts").fetchone()
            if known is not None and count != known:
                raise UserError(
                    "verdict: expected the fish as this page shows them, but another reviewer "
                    "has changed them meanwhile; look again, and repeat it"
                )
            database.execute(*insertion("verdicts", asdict(verdict)))
            for frame in frames:
                database.execute(*insertion("added_frames", asdict(frame)))
            if new_fish is not None:
                database.execute(_USED, (new_fish,))  # no later run may use it
    return verdict


def read_verdicts(path: Path) -> list[Verdict]:
    """All verdicts of a lengths.db in the order of writing. Raises OutputError."""
    with _refusing(path), closing(open_for_reading(path)) as database:
        if not (there := columns_of(database, "verdicts")):
            return []
        names = [field.name for field in fields(Verdict) if field.name in there]
        query = f"SELECT {', '.join(names)} FROM verdicts ORDER BY number"
        return [Verdict(**row) for row in rows_of(database, query)]


def read_added_frames(path: Path) -> dict[int, list[AddedFrame]]:
    """The frames of the fish that reviewers added, by track id. Raises OutputError."""
    frames: dict[int, list[AddedFrame]] = {}
    with _refusing(path), closing(open_for_reading(path)) as database:
        if not has_table(database, "added_frames"):
            return {}
        names = [field.name for field in fields(AddedFrame)]
        query = f"SELECT {', '.join(names)} FROM added_frames ORDER BY track_id, frame_index"
        for row in rows_of(database, query):
            frame = AddedFrame(**row)
            frames.setdefault(frame.track_id, []).append(frame)
    return frames


def next_track_id(path: Path) -> int:
    """A track id that neither a run nor a reviewer has used in this folder. Raises OutputError."""
    with _refusing(path), closing(open_for_reading(path)) as database:
        query = (
            "SELECT MAX(n) FROM (SELECT MAX(track_id) AS n FROM fish UNION "
            f"SELECT value FROM marks WHERE name IN ('track_id', '{REVIEWED_ID}'))"
        )
        return 1 + (database.execute(query).fetchone()[0] or 0)


def verdict_line(verdict: Verdict) -> str:
    """A verdict as JSON, for checksums: later columns only where they have a value."""
    values = asdict(verdict)
    return json.dumps({n: v for n, v in values.items() if v is not None or n not in _ADDED_COLUMNS})


def _prepare(database: sqlite3.Connection) -> None:
    database.executescript(_TABLES)
    add_columns(database, "verdicts", _ADDED_COLUMNS)


def _open_for_verdicts(path: Path) -> sqlite3.Connection:
    try:
        return open_for_writing(path)
    except DiskRefusal as error:
        raise OutputError(
            f"{path}: expected a disk to write verdicts to, got: {error.__cause__}; review a copy "
            "of the folder"
        ) from error


@contextmanager
def _refusing(path: Path) -> Generator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise OutputError(f"{path}: expected a database of lengths, got: {error}") from error
