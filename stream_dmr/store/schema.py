"""The tables of lengths.db, opened for writing and for reading.

The file is in SQLite's WAL mode while a run writes to it, so that others may read meanwhile.
Reading never writes, since archives are kept on write-protected disks.

Marks, clips and scenes say where a run goes on and what it compares with; checks are of the scale.
"""

import json
import os
import shutil
import sqlite3
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import MISSING, dataclass, fields
from functools import partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args, get_type_hints

import numpy as np

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate
from stream_dmr.store.run_facts import CatchFacts, RunFacts

_KINDS: dict[Any, str] = {str: "TEXT", int: "INTEGER", float: "REAL"}

Statement = tuple[str, tuple[object, ...]]
"""SQL, and the values of its marks."""


@contextmanager
def transaction(database: sqlite3.Connection) -> Generator[None]:
    """All that is executed within is written, or nothing of it where any of it raises."""
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            database.execute("ROLLBACK")
        raise


def insertion(table: str, values: Mapping[str, object]) -> Statement:
    """The statement that adds a row; `values` by column."""
    marks = ", ".join("?" for _ in values)
    return f"INSERT INTO {table} ({', '.join(values)}) VALUES ({marks})", tuple(values.values())


def rows_of(
    database: sqlite3.Connection, query: str, values: tuple[object, ...] = ()
) -> Iterator[dict[str, Any]]:
    """The rows that a query finds, by column."""
    found = database.execute(query, values)
    names = [column[0] for column in found.description]
    return (dict(zip(names, row, strict=True)) for row in found)


def has_table(database: sqlite3.Connection, name: str) -> bool:
    """True where there is a table of this name."""
    query = "SELECT 1 FROM sqlite_master WHERE name = ? AND type = 'table'"
    return database.execute(query, (name,)).fetchone() is not None


def add_columns(database: sqlite3.Connection, table: str, columns: Mapping[str, str]) -> None:
    """Add the columns (name -> type) that a table of an earlier version lacks."""
    present = columns_of(database, table)
    for name, kind in columns.items():
        if name not in present:
            database.execute(f"ALTER TABLE {table} ADD COLUMN {name} {kind}")


def optional_columns(facts: type) -> dict[str, str]:
    """The columns (name -> type) for the fields with a default: of str, int, float, or None."""
    hints = get_type_hints(facts)
    names = [field.name for field in fields(facts) if field.default is not MISSING]
    return {name: _KINDS[(get_args(hints[name]) or (hints[name],))[0]] for name in names}


def declaration(columns: Mapping[str, str]) -> str:
    """The columns as CREATE TABLE takes them."""
    return ", ".join(f"{name} {kind}" for name, kind in columns.items())


def columns_of(database: sqlite3.Connection, table: str) -> set[str]:
    """The names of a table's columns; none where there is no such table."""
    return {column[1] for column in database.execute(f"PRAGMA table_info({table})")}


NAME = "lengths.db"
VERSION = 1  # PRAGMA user_version
APPLICATION_ID = 0x646D726C  # "dmrl": what `file` and other programs may know it by
_LOCK_TIMEOUT_S = 5.0  # for another program that holds the file; SQLite's own default
_LOGS = ("-wal", "-journal")  # of SQLite, beside a file that is written to
_DISK_ERRORS = {
    *(sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)
}

FISH_COLUMNS = [
    *("track_id", "length_mm", "length_std_mm", "frames_seen", "frames_used", "first_frame"),
    *("last_frame", "first_timestamp_ns", "last_timestamp_ns", "status"),
]
# Older databases get those that they lack, NULL in the rows that are there. Older versions read and
# write tables that have them, so they need no new VERSION.
_OPTIONAL_COLUMNS = {"runs": optional_columns(RunFacts), "fish": optional_columns(CatchFacts)}
_TABLES = f"""
CREATE TABLE runs (
    run_id TEXT PRIMARY KEY,
    started_ns INTEGER NOT NULL, -- wall clock, ns since 1970
    ended_ns INTEGER, -- NULL: still going, or ended by a crash
    source TEXT NOT NULL,
    command TEXT NOT NULL,
    software_version TEXT NOT NULL,
    config_sha256 TEXT NOT NULL,
    calibration_sha256 TEXT NOT NULL, -- '': no calibration
    template_sha256 TEXT NOT NULL,
    {declaration(_OPTIONAL_COLUMNS["runs"])}
) STRICT;
CREATE TABLE fish (
    number INTEGER PRIMARY KEY, -- in the order in which the tracks ended
    track_id INTEGER NOT NULL UNIQUE,
    run_id TEXT NOT NULL REFERENCES runs,
    length_mm REAL, length_std_mm REAL, ci95_low_mm REAL, ci95_high_mm REAL,
    frames_seen INTEGER NOT NULL, frames_used INTEGER NOT NULL,
    first_frame INTEGER NOT NULL, last_frame INTEGER NOT NULL,
    first_timestamp_ns INTEGER NOT NULL, last_timestamp_ns INTEGER NOT NULL, -- capture time
    status TEXT NOT NULL,
    refused TEXT NOT NULL, -- JSON: reason -> number of frames
    iou REAL, -- median of the frames that were accepted: mesh and mask
    flags TEXT NOT NULL, -- JSON: what a reader of this length must know, such as a moved camera
    written_ns INTEGER NOT NULL, -- wall clock
    {declaration(_OPTIONAL_COLUMNS["fish"])}
) STRICT;
CREATE TABLE marks (name TEXT PRIMARY KEY, value INTEGER NOT NULL) STRICT;
CREATE TABLE clips (
    name TEXT PRIMARY KEY,
    frames_done INTEGER NOT NULL, -- from its start, that have left the chain
    is_done INTEGER NOT NULL -- 1: the clip after it has begun
) STRICT;
CREATE TABLE scenes (
    calibration_sha256 TEXT PRIMARY KEY,
    data BLOB NOT NULL -- what the camera saw when the calibration was first used here
) STRICT;
CREATE TABLE events (
    number INTEGER PRIMARY KEY,
    run_id TEXT NOT NULL REFERENCES runs,
    kind TEXT NOT NULL, text TEXT NOT NULL,
    timestamp_ns INTEGER NOT NULL, -- capture time
    written_ns INTEGER NOT NULL
) STRICT;
"""


class DiskRefusal(OutputError):
    """The disk doesn't let a database be used now; nothing says that it is damaged."""


def open_for_writing(path: Path) -> sqlite3.Connection:
    """Open a lengths.db, making its tables where there are none; usable from any one thread.

    Raises OutputError where the file is no such database, damaged, or of a newer version, and
    DiskRefusal where the disk refuses it.
    """
    try:
        return _opened(f"{path.absolute().as_uri()}?mode=rwc", path, make_tables=True)
    except sqlite3.Error as error:
        raise _refusal(
            path, error, remedy="move it away to begin a new one, or choose another --out"
        ) from error


def open_for_reading(path: Path) -> sqlite3.Connection:
    """Open a lengths.db without writing anything, also beside a run and on a read-only disk.

    Raises OutputError where there is none, or one that is damaged or of a newer version.
    """
    if not _size(path):
        raise OutputError(f"{path}: expected a database of lengths, found none; check the path")
    address = path.absolute().as_uri()
    try:
        if not any(_beside(path, log).exists() for log in _LOGS):  # no run goes on or has crashed
            return _opened(f"{address}?mode=ro&immutable=1", path)
        try:
            return _opened(f"{address}?mode=ro", path)
        except sqlite3.OperationalError:  # SQLite can't write its index of the log
            may_write = os.access(path.parent, os.W_OK)
            return copy_in_memory(path) if may_write else _copy_with_log(path)
    except (OSError, sqlite3.Error) as error:
        raise _refusal(path, error, remedy="the file is damaged; use a copy of it") from error


def copy_in_memory(path: Path) -> sqlite3.Connection:
    """A copy to work with while the disk has no room for SQLite's own files; empty without a file.

    Nobody else may have it open. Raises OutputError where it can't be read or is damaged.
    """
    memory = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    try:
        if _size(path) and not _size(_beside(path, "-journal")):  # else it was never made whole
            how = "mode=rw" if _size(_beside(path, "-wal")) else "mode=ro&immutable=1"
            address = f"{path.absolute().as_uri()}?{how}"
            with closing(sqlite3.connect(address, uri=True, isolation_level=None)) as file:
                file.execute("PRAGMA locking_mode = EXCLUSIVE")  # the log's index, in memory
                file.backup(memory)
            _check(memory, path)
        _prepare(memory)
    except BaseException as error:
        memory.close()
        if isinstance(error, (OSError, sqlite3.Error)):
            raise _refusal(path, error, remedy="make room, or choose another --out") from error
        raise
    return memory


def _opened(address: str, path: Path, *, make_tables: bool = False) -> sqlite3.Connection:
    database = sqlite3.connect(
        address,
        uri=True,
        timeout=_LOCK_TIMEOUT_S,
        isolation_level=None,
        check_same_thread=False,
    )
    # Text that is no UTF-8 is read as other text, not an end to all reading.
    database.text_factory = partial(str, encoding="utf-8", errors="backslashreplace")
    try:
        _check(database, path)
        if make_tables:
            _prepare(database)
        elif not has_table(database, "fish"):
            raise sqlite3.DatabaseError("it has no tables: nothing could ever be written")
    except BaseException:
        database.close()
        raise
    return database


def _copy_with_log(path: Path) -> sqlite3.Connection:
    """A copy in memory of a file with its log, where SQLite can't write beside it."""
    memory = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        shutil.copyfile(path, copy)
        for log in _LOGS:
            if _beside(path, log).exists():
                shutil.copyfile(_beside(path, log), _beside(copy, log))
        with closing(sqlite3.connect(copy, isolation_level=None)) as file:
            file.backup(memory)
    try:
        _check(memory, path)
    except BaseException:
        memory.close()
        raise
    return memory


def _beside(path: Path, suffix: str) -> Path:
    """SQLite's own file of this kind beside a database."""
    return path.with_name(path.name + suffix)


def _size(path: Path) -> int:
    """Bytes of a file; 0 where there is none."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _refusal(path: Path, error: sqlite3.Error | OSError, *, remedy: str) -> OutputError:
    # The lower byte is the error, the rest its details.
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_IOERR) & 0xFF
    kind = DiskRefusal if code in _DISK_ERRORS else OutputError
    return kind(f"{path}: expected a database of lengths, got: {error}; {remedy}")


def _check(database: sqlite3.Connection, path: Path) -> None:
    (version,) = database.execute("PRAGMA user_version").fetchone()
    (problem,) = database.execute("PRAGMA quick_check(1)").fetchone()
    if problem != "ok":
        raise sqlite3.DatabaseError(problem)
    # A view in place of a table, or a trigger, would change what a reader gets.
    others = database.execute(
        "SELECT type, name FROM sqlite_master WHERE type IN ('view', 'trigger') "
        "OR sql LIKE 'CREATE VIRTUAL%'"
    ).fetchone()
    if others is not None:
        raise sqlite3.DatabaseError("tables alone, not the {} {!r}".format(*others))
    if version > VERSION:
        raise OutputError(
            f"{path}: expected a database of version {VERSION} or before, got version {version}, "
            "which a newer stream-dmr wrote; upgrade stream-dmr or choose another --out"
        )


def _prepare(database: sqlite3.Connection) -> None:
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")
    (version,) = database.execute("PRAGMA user_version").fetchone()
    if version == 0:
        database.executescript(
            f"BEGIN; {_TABLES} PRAGMA application_id = {APPLICATION_ID}; "
            f"PRAGMA user_version = {VERSION}; COMMIT;"
        )
    for table, columns in _OPTIONAL_COLUMNS.items():
        add_columns(database, table, columns)


@dataclass(frozen=True, kw_only=True)
class AddedTable:
    """One table; its first column is `number INTEGER PRIMARY KEY`."""

    name: str
    kind: str  # of its rows in the chain of signatures
    columns: str  # SQL, after `number`

    @property
    def statement(self) -> str:
        """The SQL that makes it."""
        return (
            f"CREATE TABLE IF NOT EXISTS {self.name} (number INTEGER PRIMARY KEY, {self.columns}) "
            "STRICT"
        )


def read_added(database: Path, table: AddedTable) -> Sequence[Mapping[str, Any]]:
    """The rows of a table in the order of writing, without their numbers; none where it is missing.

    Raises OutputError.
    """
    try:
        with closing(open_for_reading(database)) as connection:
            return added_rows(connection, table)
    except sqlite3.Error as error:
        raise OutputError(f"{database}: expected its {table.name}, got: {error}") from error


def added_rows(connection: sqlite3.Connection, table: AddedTable) -> list[dict[str, Any]]:
    """As `read_added`, of an open database."""
    if not has_table(connection, table.name):
        return []
    rows = list(rows_of(connection, f"SELECT * FROM {table.name} ORDER BY number"))
    for row in rows:
        del row["number"]
    return rows


# The mark of the last id that a reviewer gave to a fish. Verdicts are summed up by themselves.
REVIEWED_ID = "reviewed_id"

# "written" counts the statements of a store, also those that sign: no sum can hold it.
_MARKS = (
    f"SELECT name, value FROM marks WHERE name NOT IN ('written', '{REVIEWED_ID}') ORDER BY name"
)
_CLIPS = "SELECT name, frames_done, is_done FROM clips ORDER BY name"
_SCENES = "SELECT calibration_sha256, data FROM scenes ORDER BY calibration_sha256"


def read_state(database: sqlite3.Connection) -> Mapping[str, object]:
    """Marks, clips and scenes, these by their hashes; a run changes them as it goes on."""
    return {
        "marks": [[*row] for row in database.execute(_MARKS)],
        "clips": [[*row] for row in database.execute(_CLIPS)],
        "scenes": [[key, sha256(data).hexdigest()] for key, data in database.execute(_SCENES)],
    }


def check_lines(database: sqlite3.Connection) -> Sequence[str]:
    """The checks of the scale in their order, each as a line of JSON; rows are only added."""
    if not has_table(database, "checks"):
        return []
    return [json.dumps(row) for row in database.execute("SELECT * FROM checks ORDER BY number")]


MAY_COUNT_TWICE = "may count twice"
# A flag of a fish that was in view at a crash: it came into view again, with another number.
INTERRUPTED = f"{MAY_COUNT_TWICE}: interrupted by a restart, finished with what was recorded"


def fish_row(estimate: LengthEstimate, flags: Sequence[str]) -> dict[str, object]:
    """The columns of a final estimate; `flags`: what a reader of its length must know."""
    low, high = (None, None) if estimate.ci95_mm is None else estimate.ci95_mm.tolist()
    row: dict[str, object] = {name: getattr(estimate, name) for name in FISH_COLUMNS}
    return row | {
        "ci95_low_mm": low,
        "ci95_high_mm": high,
        "refused": json.dumps(dict(estimate.refused)),
        "flags": json.dumps(list(flags)),
    }


def read_estimates(
    database: sqlite3.Connection, *, last: int | None = None
) -> Iterator[LengthEstimate]:
    """The final estimates, or the `last` few; the recordings have their smoothed series."""
    names = [*FISH_COLUMNS, "ci95_low_mm", "ci95_high_mm", "refused"]
    known = columns_of(database, "fish")
    names += [field.name for field in fields(CatchFacts) if field.name in known]
    wanted = "" if last is None else "WHERE number > (SELECT MAX(number) FROM fish) - ?"
    query = f"SELECT {', '.join(names)} FROM fish {wanted} ORDER BY number"
    for row in rows_of(database, query, () if last is None else (last,)):
        yield estimate_of(row)


def estimate_of(row: Mapping[str, Any]) -> LengthEstimate:
    """The final estimate of a row that `fish_row` made, without its smoothed series."""
    low, high = row["ci95_low_mm"], row["ci95_high_mm"]
    values: dict[str, Any] = {name: row[name] for name in FISH_COLUMNS}
    values |= {field.name: row.get(field.name) for field in fields(CatchFacts)}
    return LengthEstimate(
        **values,
        refused=json.loads(row["refused"]),
        ci95_mm=None if low is None else np.array([low, high]),
        timestamp_ns=row["last_timestamp_ns"],
        frame_index=row["last_frame"],
        is_final=True,
        is_frame_used=False,
        frame_reason="",
        smoothed_frames=np.zeros(0, np.int64),
        smoothed_mm=np.zeros(0),
        smoothed_std_mm=np.zeros(0),
    )
