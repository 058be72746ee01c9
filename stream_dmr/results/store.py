"""lengths.db: every finished fish in SQLite, durable the moment its track ends.

One file in the output folder, open to any reader of SQLite while it is written: WAL, synchronous
FULL. It also holds what a restart must not use again: track ids, frame numbers and capture times.
"""

import fcntl
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from threading import RLock
from uuid import uuid4

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate
from stream_dmr.results.store_rows import fish_row, read_estimates
from stream_dmr.results.store_schema import (
    MARK_EVERY_NS,
    DiskRefusal,
    copy_in_memory,
    open_database,
)

NAME = "lengths.db"
_BALLAST = "lengths.reserve"  # room that is given up when the disk is full, so that lengths fit
_BALLAST_BYTES = 1 << 20
_BALLAST_SHARE = 0.01  # of the free space, at most
_MARK = "INSERT INTO marks VALUES (?1, ?2) ON CONFLICT (name) DO UPDATE SET value = ?2"
_CLIP = "INSERT OR REPLACE INTO clips VALUES (?, ?, ?)"
_FRAMES_AHEAD = 1000  # frame numbers set aside at a time: a gap after a crash does no harm


@dataclass(frozen=True, kw_only=True)
class RunFacts:
    """What made the lengths of one run; hashes are SHA-256 in hex, "" where there is none."""

    source: str
    command: str
    software_version: str
    config_sha256: str
    calibration_sha256: str
    template_sha256: str
    source_path: str = ""  # the files that the run was given, see `RunInputs`
    source_sha256: str = ""
    boxes_path: str = ""
    boxes_sha256: str = ""
    masks_path: str = ""
    masks_sha256: str = ""
    calibration_path: str = ""
    vessel: str = ""
    trip: str = ""
    haul: str = ""


@dataclass(frozen=True, kw_only=True)
class Marks:
    """The last of everything that was handed out in this folder; 0 where nothing was."""

    track_id: int = 0
    frame_index: int = 0
    timestamp_ns: int = 0
    written: int = 0  # statements, by which a commit that failed tells whether it did


class LengthStore:
    """The lengths of one output folder, and this run's right to add to them. Thread-safe.

    A fish that the disk refuses is kept in memory and tried again with everything that follows;
    `trouble` says so meanwhile, and `close` raises OutputError if it never got there.
    """

    def __init__(self, out_dir: Path, facts: RunFacts, *, waits: bool = False) -> None:
        """Raises OutputError where another run writes there or the file can't be used.

        With `waits` not where the disk refuses it: then all waits in memory from the start.
        """
        self.path = out_dir / NAME
        self.run_id = uuid4().hex
        self.trouble = ""  # why the last row could not be written; "" when all are
        self._facts = facts
        self._ballast = out_dir / _BALLAST
        self._lock = RLock()
        self._pending: list[tuple[str, tuple[object, ...]]] = []
        self._clip: tuple[str, int] | None = None  # in work, and its frames done
        self._folder = _lock_folder(out_dir)
        try:
            self._database, self._is_reached = self._open(waits=waits)
            self._is_stand_in = not self._is_reached
            self.before = self._handed_out = _marks(self._database)
            self._begin_run(waits=waits)
        except BaseException:
            os.close(self._folder)
            raise
        self._marked_at_ns = time.monotonic_ns()
        _set_aside(self._ballast)

    def add(
        self, estimate: LengthEstimate, *, iou: float | None = None, flags: Sequence[str] = ()
    ) -> None:
        """Make a final estimate durable; `flags` are what a reader of this length must know."""
        values = fish_row(estimate, flags) | {"iou": iou, "run_id": self.run_id}
        values["written_ns"] = time.time_ns()
        marks = ", ".join("?" for _ in values)
        self._write(f"INSERT INTO fish ({', '.join(values)}) VALUES ({marks})", *values.values())

    def reserve_track(self, track_id: int) -> None:
        """Take note, durably, that an id is used: no later run in this folder uses it again."""
        if track_id > self._handed_out.track_id:
            self._mark(track_id=track_id)

    def frame_passed(self, *, frame_index: int, timestamp_ns: int) -> None:
        """Take note of a frame; durable for its number at once, for its time within seconds."""
        is_due = time.monotonic_ns() - self._marked_at_ns > MARK_EVERY_NS
        if is_due or frame_index > self._handed_out.frame_index:
            self._marked_at_ns = time.monotonic_ns()
            self._mark(frame_index=frame_index + _FRAMES_AHEAD, timestamp_ns=timestamp_ns)

    def clip_progress(self, name: str, *, frames_done: int) -> None:
        """Keep in mind how far a clip is: it becomes durable with the next fish or mark.

        So a restart neither repeats a finished fish nor begins the clip anew.
        """
        with self._lock:
            if self._clip is not None and self._clip[0] != name:
                self._pending.append((_CLIP, (*self._clip, 1)))
            self._clip = name, frames_done

    def clips_before(self) -> tuple[set[str], dict[str, int]]:
        """Of earlier runs: the clips that are done, and the frames done of others."""
        rows = self._database.execute("SELECT name, frames_done, is_done FROM clips").fetchall()
        done = {name for name, _, is_done in rows if is_done}
        return done, {name: frames for name, frames, is_done in rows if not is_done}

    def resume_after_ns(self) -> int:
        """The capture time after which a live source goes on, whatever the clock was set to."""
        mark_ns = self.before.timestamp_ns
        return mark_ns if time.time_ns() > mark_ns else mark_ns + MARK_EVERY_NS

    def scene(self) -> bytes | None:
        """What the camera saw when this run's calibration was first used here."""
        query = "SELECT data FROM scenes WHERE calibration_sha256 = ?"
        row = self._database.execute(query, (self._facts.calibration_sha256,)).fetchone()
        return None if row is None else row[0]

    def keep_scene(self, data: bytes) -> None:
        """Keep the scene of this calibration, for this run and later ones."""
        key = self._facts.calibration_sha256
        self._write("INSERT OR IGNORE INTO scenes VALUES (?, ?)", key, data)

    def first_ious(self, count: int) -> list[float]:
        """Of the first fish that were measured here with this calibration."""
        query = (
            "SELECT iou FROM fish JOIN runs USING (run_id) "
            "WHERE calibration_sha256 = ? AND iou IS NOT NULL ORDER BY number LIMIT ?"
        )
        rows = self._database.execute(query, (self._facts.calibration_sha256, count))
        return [iou for (iou,) in rows]

    def note(self, kind: str, text: str, *, timestamp_ns: int) -> None:
        """Write an event that later readers of the lengths should know of."""
        self._write(
            "INSERT INTO events (run_id, kind, text, timestamp_ns, written_ns) "
            "VALUES (?, ?, ?, ?, ?)",
            *(self.run_id, kind, text, timestamp_ns, time.time_ns()),
        )

    def estimates(self) -> list[LengthEstimate]:
        """All finished fish of this folder, in the order in which their tracks ended."""
        with self._lock, _refusing(self.path):
            return list(read_estimates(self._database))

    def close(self) -> None:
        """End the run and leave one file. Idempotent. OutputError where fish are not written."""
        if self._folder < 0:
            return
        self._write("UPDATE runs SET ended_ns = ? WHERE run_id = ?", time.time_ns(), self.run_id)
        with suppress(sqlite3.Error):
            self._database.close()
        with suppress(OSError):
            self._ballast.unlink(missing_ok=True)
        os.close(self._folder)
        self._folder = -1
        if self.trouble:
            raise OutputError(
                f"{self.path}: expected room for {len(self._pending)} more rows, got: "
                f"{self.trouble}; the recording has them: make room and run stream-dmr recover"
            )

    def _open(self, *, waits: bool) -> tuple[sqlite3.Connection, bool]:
        """The file, or with `waits` a copy of it in memory, and which."""
        try:
            return open_database(self.path), True
        except DiskRefusal as error:
            if not waits:
                raise
            self.trouble = str(error.__cause__)
        self._give_up_ballast()
        with suppress(DiskRefusal):
            return open_database(self.path), True
        return copy_in_memory(self.path), False

    def _begin_run(self, *, waits: bool) -> None:
        values = {"run_id": self.run_id, "started_ns": time.time_ns()}
        values |= {field.name: getattr(self._facts, field.name) for field in fields(self._facts)}
        marks = ", ".join("?" for _ in values)
        statement = f"INSERT INTO runs ({', '.join(values)}) VALUES ({marks})"
        self._pending.append((statement, tuple(values.values())))
        if self._is_reached:
            self._write_pending()
            if self.trouble and not waits:
                raise OutputError(
                    f"{self.path}: expected a database of lengths to write to, got: "
                    f"{self.trouble}; make room, or choose another --out"
                )

    def _mark(self, **marks: int) -> None:
        with self._lock:
            higher = {n: max(v, getattr(self._handed_out, n)) for n, v in marks.items()}
            self._handed_out = replace(self._handed_out, **higher)
            self._write_pending()

    def _write(self, statement: str, *values: object) -> None:
        with self._lock:
            self._pending.append((statement, values))
            self._write_pending()

    def _write_pending(self) -> None:
        """Commit all that waits; where that fails, give up the ballast and try once more."""
        for is_last in (False, True):
            try:
                self._reach_file()
                self._commit()
                return
            except sqlite3.IntegrityError:  # a fish that is there already: our own mistake
                raise
            except (sqlite3.Error, OutputError) as error:
                self.trouble = str(error.__cause__ or error)
            self._is_reached = False
            if not is_last:
                self._give_up_ballast()

    def _commit(self) -> None:
        marks = replace(self._handed_out, written=self._handed_out.written + len(self._pending))
        with _transaction(self._database):
            for statement, values in self._pending:
                self._database.execute(statement, values)
            if self._clip is not None:
                self._database.execute(_CLIP, (*self._clip, 0))
            for field in fields(marks):
                self._database.execute(_MARK, (field.name, getattr(marks, field.name)))
        self._handed_out = marks
        self._pending.clear()
        self.trouble = ""

    def _reach_file(self) -> None:
        """Open the file anew after trouble; what was committed in spite of it waits no more."""
        if self._is_reached:
            return
        if not self._is_stand_in:
            self._database.close()  # SQLite may hold on to a state of the file that never was
        try:
            fresh = open_database(self.path)
        except DiskRefusal:
            if not self._is_stand_in:
                self._database, self._is_stand_in = copy_in_memory(self.path), True
            raise
        self._database.close()
        self._database, self._is_reached, self._is_stand_in = fresh, True, False
        written = _marks(fresh).written
        del self._pending[: max(0, written - self._handed_out.written)]
        self._handed_out = replace(self._handed_out, written=written)

    def _give_up_ballast(self) -> None:
        with suppress(OSError):
            self._ballast.unlink(missing_ok=True)


def _marks(database: sqlite3.Connection) -> Marks:
    return Marks(**dict(database.execute("SELECT name, value FROM marks")))


@contextmanager
def _transaction(database: sqlite3.Connection) -> Iterator[None]:
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            database.execute("ROLLBACK")
        raise


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise OutputError(
            f"{path}: expected a database of lengths to write to, got: {error}; make room, or "
            "choose another --out"
        ) from error


def flagged_fish(out_dir: Path) -> set[int]:
    """The ids of fish whose length has a flag. Raises OutputError where they can't be read."""
    path = out_dir / NAME
    if not path.exists():
        return set()
    try:
        database = open_database(path, read_only=True)
    except DiskRefusal:  # a full disk has no room for SQLite's own files
        database = copy_in_memory(path)
    with _refusing(path), closing(database):
        rows = database.execute("SELECT track_id FROM fish WHERE flags != '[]'")
        return {track_id for (track_id,) in rows}


def require_free(out_dir: Path) -> None:
    """Raise OutputError where another run is writing to the folder."""
    os.close(_lock_folder(out_dir))


def _lock_folder(out_dir: Path) -> int:
    """Take the folder for this process alone; a crash gives it back."""
    folder = os.open(out_dir, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(folder)
        raise OutputError(
            f"{out_dir}: expected a folder of its own for each run, found one that another run is "
            "writing to; wait for that one or choose another --out"
        ) from None
    return folder


def _set_aside(ballast: Path) -> None:
    """Take a little room on the disk beforehand; a disk with hardly any is left alone."""
    with suppress(OSError):
        room = os.statvfs(ballast.parent)
        size = min(_BALLAST_BYTES, int(_BALLAST_SHARE * room.f_bavail * room.f_frsize))
        if size > 0:
            with ballast.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, size)
