"""The tables of lengths.db, opened for writing and for reading.

The file is in SQLite's WAL mode while a run writes to it, so that others may read meanwhile.
Reading never writes, since archives are kept on write-protected disks.
"""

import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from stream_dmr.errors import OutputError
from stream_dmr.results.catch_facts import CatchFacts
from stream_dmr.results.run_facts import RunFacts
from stream_dmr.results.sql import add_columns, declaration, has_table, optional_columns

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
