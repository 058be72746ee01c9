"""The tables of lengths.db, opened for writing and for reading.

The file is in SQLite's WAL mode while a run writes to it, so that others may read meanwhile.
Reading never writes, since archives are kept on write-protected disks.

Marks, clips and scenes are the state from which a run continues; checks are of the scale.
"""

import json
import os
import shutil
import sqlite3
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, fields
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate

NAME = "lengths.db"
VERSION = 1  # PRAGMA user_version
APPLICATION_ID = 0x646D726C  # "dmrl", by which `file` and other programs may recognise it
_LOCK_TIMEOUT_S = 5.0  # for another program that holds the file; SQLite's own default
_LOGS = ("-wal", "-journal")  # of SQLite, beside a file that is written to
_DISK_ERRORS = {
    *(sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)
}

T = TypeVar("T")
Statement = tuple[str, tuple[object, ...]]
"""SQL, and the values of its marks."""

# Columns that older databases lack are the last of their table, and may be NULL.
_SQL = """
CREATE TABLE runs (
    run_id TEXT PRIMARY KEY,
    started_ns INTEGER NOT NULL, -- wall clock, ns since 1970
    ended_ns INTEGER, -- NULL: still going, or ended by a crash
    source TEXT NOT NULL, command TEXT NOT NULL, software_version TEXT NOT NULL,
    config_sha256 TEXT NOT NULL,
    calibration_sha256 TEXT NOT NULL, -- '': no calibration
    template_sha256 TEXT NOT NULL,
    source_path TEXT, source_sha256 TEXT, boxes_path TEXT, boxes_sha256 TEXT, masks_path TEXT,
    masks_sha256 TEXT, calibration_path TEXT, nmea_path TEXT, nmea_sha256 TEXT,
    species_model_path TEXT, species_model_sha256 TEXT, vessel TEXT, trip TEXT, haul TEXT,
    ended_by TEXT, frames_done INTEGER, frames_promised INTEGER, utc_zero_ns INTEGER
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
    species_code TEXT, species_share REAL, fate TEXT, fate_share REAL
) STRICT;
CREATE TABLE events (
    number INTEGER PRIMARY KEY,
    run_id TEXT NOT NULL REFERENCES runs,
    kind TEXT NOT NULL, text TEXT NOT NULL,
    timestamp_ns INTEGER NOT NULL, -- capture time
    written_ns INTEGER NOT NULL
) STRICT;
CREATE TABLE hauls (
    number INTEGER PRIMARY KEY,
    run_id TEXT NOT NULL, -- the run that was told; '': a folder, after its run
    what TEXT NOT NULL, -- start, end
    name TEXT NOT NULL, -- of the haul
    timestamp_ns INTEGER NOT NULL, -- on the clock of the frames
    said_by TEXT NOT NULL, -- who or what said so
    written_ns INTEGER NOT NULL -- wall clock
) STRICT;
CREATE TABLE watched (
    number INTEGER PRIMARY KEY,
    run_id TEXT NOT NULL REFERENCES runs,
    first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, -- frames without a pause, capture times
    frames INTEGER NOT NULL, -- that were measured
    frames_lost INTEGER NOT NULL, -- that came from the camera and were not
    written_ns INTEGER NOT NULL -- wall clock
) STRICT;
CREATE TABLE positions (
    number INTEGER PRIMARY KEY,
    run_id TEXT NOT NULL REFERENCES runs,
    timestamp_ns INTEGER NOT NULL, -- on the clock of the frames
    utc_ns INTEGER, -- the receiver's, since 1970; NULL: it gave no date
    latitude REAL NOT NULL, longitude REAL NOT NULL, -- degrees, WGS 84
    speed_knots REAL, course_deg REAL, -- over ground
    is_joined INTEGER NOT NULL, -- 0: positions are missing between the row before and this one
    written_ns INTEGER NOT NULL -- wall clock
) STRICT;
CREATE TABLE checks (
    number INTEGER PRIMARY KEY,
    time_ns INTEGER NOT NULL, -- wall clock
    source TEXT NOT NULL,
    calibration_sha256 TEXT NOT NULL,
    known_mm REAL NOT NULL, error_mm REAL NOT NULL,
    error_percent REAL NOT NULL, worst_percent REAL NOT NULL,
    limit_percent REAL NOT NULL -- an alarm beyond it
) STRICT;
CREATE TABLE verdicts (
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
    written_ns INTEGER NOT NULL, -- wall clock
    undoes INTEGER, other_fish INTEGER, fish TEXT, frames_sha256 TEXT, reading TEXT, fate TEXT,
    condition TEXT
) STRICT;
CREATE TABLE added_frames (
    track_id INTEGER NOT NULL, frame_index INTEGER NOT NULL,
    crop BLOB NOT NULL, fit BLOB NOT NULL, fish BLOB NOT NULL, -- messages, encoded as recorded
    PRIMARY KEY (track_id, frame_index)
) STRICT;
CREATE TABLE chain (
    number INTEGER PRIMARY KEY, -- from 1, without gaps
    previous TEXT NOT NULL, -- SHA-256 of the entry before it
    -- of what: a table's row (fish, event, run, haul, watched, position, checks), or end, state,
    -- file, found, removed
    kind TEXT NOT NULL, name TEXT NOT NULL,
    content_sha256 TEXT NOT NULL,
    time_ns INTEGER NOT NULL, -- wall clock
    signature TEXT NOT NULL -- Ed25519, base64
) STRICT;
CREATE TABLE clips (
    name TEXT PRIMARY KEY,
    frames_done INTEGER NOT NULL, -- from its start, that have left the chain
    is_done INTEGER NOT NULL -- 1: the clip after it has begun
) STRICT;
CREATE TABLE scenes (
    calibration_sha256 TEXT PRIMARY KEY,
    data BLOB NOT NULL -- what the camera saw when the calibration was first used here
) STRICT;
CREATE TABLE marks (name TEXT PRIMARY KEY, value INTEGER NOT NULL) STRICT;
"""


@dataclass(frozen=True)
class Table:
    """A table of lengths.db."""

    name: str
    order: str = "number"  # of its rows
    kind: str = ""  # of its rows in the ledger

    @property
    def columns(self) -> "_Columns":
        """The columns as declared, whatever a file has."""
        return _declared()[self.name][1]


_Columns = Mapping[str, tuple[str, bool]]
"""Type of each column, and whether it may be missing."""

RUNS = Table("runs", order="rowid", kind="run")
FISH = Table("fish", kind="fish")
EVENTS = Table("events", kind="event")
HAULS = Table("hauls", kind="haul")
WATCHED = Table("watched", kind="watched")
POSITIONS = Table("positions", kind="position")
CHECKS = Table("checks", kind="checks")
VERDICTS = Table("verdicts")
ADDED_FRAMES = Table("added_frames", order="track_id, frame_index")
LEDGER = Table("chain")
MARKS = Table("marks", order="name")
CLIPS = Table("clips", order="name")
SCENES = Table("scenes", order="calibration_sha256")


@cache
def _declared() -> Mapping[str, tuple[str, _Columns]]:
    with closing(sqlite3.connect(":memory:")) as empty:
        empty.executescript(_SQL)
        made = empty.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall()
        return {name: (statement, _columns(empty, name)) for name, statement in made}


def _missing(database: sqlite3.Connection) -> list[str]:
    (version,) = database.execute("PRAGMA user_version").fetchone()
    statements = list[str]()
    if version == 0:  # new; or of another program, if such a table is there
        statements += [
            f"PRAGMA application_id = {APPLICATION_ID}",
            f"PRAGMA user_version = {VERSION}",
        ]
    for table, (statement, columns) in _declared().items():
        present = _columns(database, table) if version else {}
        if not present:
            statements.append(statement)
            continue
        missing = (f"{name} {kind}" for name, (kind, _) in columns.items() if name not in present)
        statements += [f"ALTER TABLE {table} ADD COLUMN {column}" for column in missing]
    return statements


def _columns(database: sqlite3.Connection, table: str) -> _Columns:
    found = database.execute(f"PRAGMA table_info({table})")
    return {name: (kind, not (required or key)) for _, name, kind, required, _, key in found}


def rows(
    database: sqlite3.Connection, table: Table, *, after: int | None = None
) -> Iterator[dict[str, Any]]:
    """The rows in their order, by column: None in columns that are missing.

    `after`: only rows whose number is higher. There are none if the table is missing.
    """
    present = _columns(database, table.name)
    names = [n for n, (_, is_optional) in table.columns.items() if n in present or not is_optional]
    if present:
        which = "" if after is None else f"WHERE number > {after:d} "
        query = f"SELECT {', '.join(names)} FROM {table.name} {which}ORDER BY {table.order}"
        for row in database.execute(query):
            yield dict.fromkeys(table.columns) | dict(zip(names, row, strict=True))


def column_values(database: sqlite3.Connection, table: Table, column: str) -> Iterator[Any]:
    """The values of a required column; none if the table is missing."""
    if _columns(database, table.name):
        for (value,) in database.execute(f"SELECT {column} FROM {table.name}"):
            yield value


def records(
    database: sqlite3.Connection, table: Table, kind: type[T], *, after: int | None = None
) -> list[T]:
    """The rows, see `rows`, as objects of a dataclass whose fields are columns."""
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    return [
        kind(**{name: row[name] for name in names}) for row in rows(database, table, after=after)
    ]


@contextmanager
def refusing(path: Path) -> Generator[None]:
    """Raise an error of SQLite as OutputError."""
    try:
        yield
    except sqlite3.Error as error:
        raise OutputError(f"{path}: expected a database of lengths, got: {error}") from error


@contextmanager
def reading(path: Path) -> Generator[sqlite3.Connection]:
    """A lengths.db, open for reading. Raises OutputError, also if it turns out to be damaged."""
    with refusing(path), closing(open_for_reading(path)) as database:
        yield database


def read_rows(path: Path, table: Table) -> list[dict[str, Any]]:
    """The rows of a table. Raises OutputError."""
    with reading(path) as database:
        return list(rows(database, table))


def add_row(path: Path, table: Table, values: Mapping[str, object]) -> None:
    """Write a row into a lengths.db, durably. Raises OutputError."""
    with refusing(path), closing(open_for_writing(path)) as database:
        database.execute(*insertion(table, values))


def insertion(table: Table, values: Mapping[str, object]) -> Statement:
    """The statement that adds a row; `values` by column."""
    marks = ", ".join("?" for _ in values)
    return f"INSERT INTO {table.name} ({', '.join(values)}) VALUES ({marks})", (*values.values(),)


@contextmanager
def transaction(database: sqlite3.Connection) -> Generator[None]:
    """Write all that is executed within, or nothing if any of it raises."""
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            database.execute("ROLLBACK")
        raise


class DiskRefusal(OutputError):
    """The disk doesn't let a database be used now; it need not be damaged."""


def open_for_writing(path: Path) -> sqlite3.Connection:
    """Open a lengths.db, making missing tables; usable from any thread, but one at a time.

    Raises OutputError if the file is no such database, damaged, or of a newer version, and
    DiskRefusal if the disk refuses it.
    """
    try:
        return _opened(f"{path.absolute().as_uri()}?mode=rwc", path, make_tables=True)
    except sqlite3.Error as error:
        raise _refusal(
            path, error, remedy="move it away to begin a new one, or choose another --out"
        ) from error


def open_for_reading(path: Path) -> sqlite3.Connection:
    """Open a lengths.db without writing anything, also beside a run and on a read-only disk.

    Raises OutputError if there is none, or if it is damaged or of a newer version.
    """
    if not _size(path):
        raise OutputError(f"{path}: expected a database of lengths, found none; check the path")
    address = path.absolute().as_uri()
    try:
        if not any(_beside(path, log).exists() for log in _LOGS):  # no run is active or has crashed
            return _opened(f"{address}?mode=ro&immutable=1", path)
        try:
            return _opened(f"{address}?mode=ro", path)
        except sqlite3.OperationalError:  # SQLite can't write its index of the log
            may_write = os.access(path.parent, os.W_OK)
            return copy_in_memory(path) if may_write else _copy_with_log(path)
    except (OSError, sqlite3.Error) as error:
        raise _refusal(path, error, remedy="the file is damaged; use a copy of it") from error


def copy_database(path: Path, copy: Path) -> None:
    """Make a copy to try something on, also beside a run. Raises OutputError."""
    with reading(path) as database, closing(sqlite3.connect(copy)) as made:
        database.backup(made)


def copy_in_memory(path: Path) -> sqlite3.Connection:
    """A copy to work with while the disk has no room for SQLite's own files; empty without a file.

    Nobody else may have it open. Raises OutputError if it can't be read or is damaged.
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
        address, uri=True, timeout=_LOCK_TIMEOUT_S, isolation_level=None, check_same_thread=False
    )
    # Text that is no UTF-8 is read as other text, not an end to all reading.
    database.text_factory = partial(str, encoding="utf-8", errors="backslashreplace")
    try:
        _check(database, path)
        if make_tables:
            _prepare(database)
        elif not _columns(database, FISH.name):
            raise sqlite3.DatabaseError("it has no tables: nothing could ever be written")
    except BaseException:
        database.close()
        raise
    return database


def _copy_with_log(path: Path) -> sqlite3.Connection:
    """A copy in memory of a file with its log, if SQLite can't write beside it."""
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
    """Bytes of a file; 0 if there is none."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _refusal(path: Path, error: sqlite3.Error | OSError, *, remedy: str) -> OutputError:
    # The lower byte is the error, the rest its details.
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_IOERR) & 0xFF
    kind = DiskRefusal if code in _DISK_ERRORS else OutputError
    if code == sqlite3.SQLITE_FULL:  # another database would find no room either
        remedy = "make room or choose another --out"
    if code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN):
        remedy = "give this user access to its folder, or work on a copy"
    return kind(f"{path}: expected a database of lengths, got: {error}; {remedy}")


def _check(database: sqlite3.Connection, path: Path) -> None:
    (version,) = database.execute("PRAGMA user_version").fetchone()
    (problem,) = database.execute("PRAGMA quick_check(1)").fetchone()
    if problem != "ok":
        raise sqlite3.DatabaseError(problem)
    # A view in place of a table, or a trigger, would change the rows that a reader gets.
    others = database.execute(
        "SELECT type, name FROM sqlite_master WHERE type IN ('view', 'trigger') "
        "OR sql LIKE 'CREATE VIRTUAL%'"
    ).fetchone()
    if others is not None:
        raise sqlite3.DatabaseError("tables alone, not the {} {!r}".format(*others))
    if version > VERSION:
        raise OutputError(
            f"{path}: expected a database of version {VERSION} or before, got version {version}, "
            "which a newer stream-dmr wrote; upgrade stream-dmr to use it"
        )


def _prepare(database: sqlite3.Connection) -> None:
    """Make the tables and columns that are missing, all of them or none.

    Older programs read and write files that have more, so user_version stays.
    """
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")
    if _missing(database):
        with transaction(database):
            for statement in _missing(database):
                database.execute(statement)


MARK = "INSERT INTO marks VALUES (?1, ?2) ON CONFLICT (name) DO UPDATE SET value = ?2"
REVIEWED_ID = "reviewed_id"  # the mark of the last id that a reviewer gave to a fish
WRITTEN = "written"
"""The mark of how many statements were committed: a commit that failed may have been one."""


def read_state(database: sqlite3.Connection) -> Mapping[str, object]:
    """Marks, clips and scenes, these by their hashes; a run changes them continually.

    Without the marks of written statements (signing statements are counted too) and of reviews.
    """
    marks = [[*row.values()] for row in rows(database, MARKS)]
    return {
        "marks": [mark for mark in marks if mark[0] not in (WRITTEN, REVIEWED_ID)],
        "clips": [[*row.values()] for row in rows(database, CLIPS)],
        "scenes": [
            [row["calibration_sha256"], sha256(row["data"]).hexdigest()]
            for row in rows(database, SCENES)
        ],
    }


def check_lines(database: sqlite3.Connection) -> Sequence[str]:
    """The checks of the scale in their order, each as a line of JSON; rows are only added."""
    return [json.dumps([*row.values()]) for row in rows(database, CHECKS)]


MAY_COUNT_TWICE = "may count twice"
# A flag of a fish that was in view at a crash: it came into view again, with another number.
INTERRUPTED = f"{MAY_COUNT_TWICE}: interrupted by a restart, finished with what was recorded"
CUT_OFF = "cut off"
# Flags of a fish that was in view at an end other than the source's.
CUT_OFF_BY_STOP = f"{CUT_OFF}: in view when the run was stopped"
CUT_OFF_BY_SOURCE = f"{CUT_OFF}: in view where the source is damaged or cut off"
BLURRED = "blurred"
_MIN_BLUR_STD = 0.015  # of the length, from which on it is said; chosen


def flags_of(estimate: LengthEstimate, known: Iterable[str] = ()) -> list[str]:
    """The known flags of a fish, and those of its estimate, which may be another than before."""
    flags = [flag for flag in known if not flag.startswith(BLURRED)]
    if estimate.length_mm is None or estimate.blur_std_ratio < _MIN_BLUR_STD:
        return flags
    return [*flags, f"{BLURRED}: its ends are, as by a long exposure, and it may be shorter"]


def flags_in_status(flags: Iterable[str]) -> str:
    """The text of flags beside the status in tables of fish, such as `; cut off`."""
    shown = [
        name for name in (MAY_COUNT_TWICE, CUT_OFF, BLURRED) if any(name in flag for flag in flags)
    ]
    return "".join(f"; {name}" for name in shown)


ESTIMATE_COLUMNS = [
    *("track_id", "length_mm", "length_std_mm", "frames_seen", "frames_used", "first_frame"),
    *("last_frame", "first_timestamp_ns", "last_timestamp_ns", "status"),
]

_FISH_COLUMNS = [*FISH.columns]
LATER_COLUMNS = _FISH_COLUMNS[_FISH_COLUMNS.index("written_ns") + 1 :]
"""Columns of `fish` that older databases lack: attributes of the final estimate."""


def fish_row(estimate: LengthEstimate, flags: Sequence[str]) -> dict[str, object]:
    """The columns of a final estimate but LATER_COLUMNS, which an edit of a fish has not."""
    low, high = (None, None) if estimate.ci95_mm is None else estimate.ci95_mm.tolist()
    row: dict[str, object] = {name: getattr(estimate, name) for name in ESTIMATE_COLUMNS}
    return row | {
        "ci95_low_mm": low,
        "ci95_high_mm": high,
        "refused": json.dumps(dict(estimate.refused)),
        "flags": json.dumps(list(flags)),
    }


def read_estimates(database: sqlite3.Connection, *, after: int | None) -> list[LengthEstimate]:
    """The final estimates, see `rows`; the recordings have their smoothed series."""
    return [estimate_of(row) for row in rows(database, FISH, after=after)]


_NO_FRAMES, _NO_LENGTHS = np.zeros(0, np.int64), np.zeros(0)
_NO_FRAMES.flags.writeable = _NO_LENGTHS.flags.writeable = False  # shared by a hundred thousand


def estimate_of(row: Mapping[str, Any]) -> LengthEstimate:
    """The final estimate of a row of `fish`, without its smoothed series."""
    low, high = row["ci95_low_mm"], row["ci95_high_mm"]
    values: dict[str, Any] = {name: row[name] for name in ESTIMATE_COLUMNS}
    values |= {name: row.get(name) for name in LATER_COLUMNS}
    return LengthEstimate(
        **values,
        refused=json.loads(row["refused"]),
        ci95_mm=None if low is None else np.array([low, high]),
        timestamp_ns=row["last_timestamp_ns"],
        frame_index=row["last_frame"],
        is_final=True,
        is_frame_used=False,
        frame_reason="",
        smoothed_frames=_NO_FRAMES,
        smoothed_mm=_NO_LENGTHS,
        smoothed_std_mm=_NO_LENGTHS,
    )
