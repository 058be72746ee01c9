"""LengthStore: writes every finished fish into lengths.db, durable the moment its track ends.

The database also holds the track ids, frame numbers and capture times that a restart must not use
again.
"""

import json
import os
import sqlite3
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from threading import RLock
from typing import Any, Literal
from uuid import uuid4

from stream_dmr.errors import OutputError
from stream_dmr.files import FolderLock, ReservedSpace
from stream_dmr.messages import LengthEstimate
from stream_dmr.store.ledger import END, FILE_KINDS, STATE, Signer, lines_sha256
from stream_dmr.store.run_facts import END_COLUMNS, NOT_ENDED, RunFacts
from stream_dmr.store.schema import (
    CHECKS,
    CLIPS,
    EVENTS,
    FISH,
    LATER_COLUMNS,
    MARK,
    NAME,
    REVIEWED_ID,
    RUNS,
    WRITTEN,
    DiskRefusal,
    Statement,
    Table,
    check_lines,
    column_values,
    copy_in_memory,
    fish_row,
    insertion,
    open_for_writing,
    read_estimates,
    read_state,
    rows,
    transaction,
)


class WaitingRows:
    """Statements for a lengths.db, in order, and its connection. Not thread-safe.

    Statements that the disk refuses stay in memory and are tried again with all later ones;
    meanwhile a copy of the file in memory answers queries.
    """

    def __init__(
        self,
        path: Path,
        reserve: ReservedSpace,
        *,
        waits_for_disk: bool,
        state: Callable[[], Iterable[Statement]],
    ) -> None:
        """`state` returns statements that every commit adds, as they are at that moment.

        Raises OutputError if the file can't be used; with `waits_for_disk` only if the disk is not
        the reason.
        """
        self._path, self._reserve, self._state = path, reserve, state
        self.pending: list[Statement] = []
        self.trouble = ""  # why the last row could not be written; "" when all are
        self.database, self.is_reached = self._open(waits_for_disk=waits_for_disk)
        self._opened = path.stat() if self.is_reached else None
        self._is_stand_in = not self.is_reached
        self._written = _num_written(self.database)

    def write(self, *statements: Statement) -> None:
        """Commit waiting statements and these; if that fails, again with the reserved space."""
        self.pending += statements
        for is_last in (False, True):
            try:
                self._reach_file()
                self._commit()
                return
            except sqlite3.IntegrityError:  # a fish that is there already: our own mistake
                raise
            except (sqlite3.Error, OutputError) as error:
                self.trouble = str(error.__cause__ or error)
            self.is_reached = False
            if not is_last:
                self._reserve.release()

    @property
    def is_in_place(self) -> bool:
        """False if the open file was renamed, deleted or replaced."""
        if self._opened is None or not self.is_reached:
            return True
        try:
            return os.path.samestat(self._opened, self._path.stat())
        except OSError:
            return False

    def close(self) -> None:
        """Close the file; statements that still wait are lost."""
        with suppress(sqlite3.Error):
            self.database.close()

    def _open(self, *, waits_for_disk: bool) -> tuple[sqlite3.Connection, bool]:
        """The file and True, or a copy of it in memory and False."""
        try:
            return open_for_writing(self._path), True
        except DiskRefusal as error:
            if not waits_for_disk:
                raise
            self.trouble = str(error.__cause__)
        self._reserve.release()
        with suppress(DiskRefusal):
            return open_for_writing(self._path), True
        return copy_in_memory(self._path), False

    def _commit(self) -> None:
        written = self._written + len(self.pending)
        with transaction(self.database):
            for statement, values in (*self.pending, *self._state(), (MARK, (WRITTEN, written))):
                self.database.execute(statement, values)
        self._written = written
        self.pending.clear()
        self.trouble = ""

    def _reach_file(self) -> None:
        """Open the file again after an error; forget rows that were committed in spite of it."""
        if self.is_reached:
            return
        if not self._is_stand_in:
            self.database.close()  # SQLite may hold on to a state of the file that never was
        try:
            fresh = open_for_writing(self._path)
        except DiskRefusal:
            if not self._is_stand_in:
                self.database, self._is_stand_in = copy_in_memory(self._path), True
            raise
        self.database.close()
        self.database, self.is_reached, self._is_stand_in = fresh, True, False
        self._opened = self._path.stat()
        written = _num_written(fresh)
        del self.pending[: max(0, written - self._written)]
        self._written = written


def _num_written(database: sqlite3.Connection) -> int:
    return dict(database.execute("SELECT name, value FROM marks")).get(WRITTEN, 0)


MARK_EVERY_NS = 5_000_000_000  # capture times that a crash may leave unmarked; chosen
_BEGIN_ANEW = "what is measured will not be found here: end the run and begin it anew"
_FRAMES_AHEAD = 1000  # frame numbers that are marked as used at a time; a crash skips the rest
_COUNTS = "UPDATE runs SET frames_done = ?, frames_promised = ? WHERE run_id = ?"
_END = f"UPDATE runs SET {' = ?, '.join(END_COLUMNS)} = ? WHERE run_id = ?"
_CLIP = "INSERT OR REPLACE INTO clips VALUES (?, ?, ?)"


@dataclass(frozen=True, kw_only=True)
class Marks:
    """The last numbers that runs in this folder have used; 0 if there was none."""

    track_id: int = 0
    frame_index: int = 0
    timestamp_ns: int = 0  # capture time


class LengthStore:
    """The lengths of one output folder, which it locks for this run. Thread-safe.

    A row that the disk refuses stays in memory and is tried again with all later rows;
    `trouble` has the reason meanwhile, and `close` raises OutputError if it was never written.
    """

    def __init__(
        self,
        out_dir: Path,
        facts: RunFacts,
        *,
        waits_for_disk: bool = False,
        signer: Signer | None = None,
    ) -> None:
        """Raises OutputError if another run writes there or the file can't be used.

        With `waits_for_disk`, rows wait in memory from the start if the disk refuses the file. With
        a `signer`, all rows are signed in the transaction that writes them.
        """
        self.path = out_dir / NAME
        self.run_id = uuid4().hex
        self._facts = replace(facts, ended_by=NOT_ENDED)
        self._reserve = ReservedSpace(out_dir)
        self._lock = RLock()
        self._clip: tuple[str, int] | None = None  # in work, and its frames done
        self._lock_of_folder = FolderLock(out_dir)
        try:
            self._rows = WaitingRows(
                self.path, self._reserve, waits_for_disk=waits_for_disk, state=self._state
            )
            self.before = self._used = _marks(self._rows.database)
            self.last_ns = self.before.timestamp_ns  # capture time of the last frame
            self._signer = signer or Signer(None)
            self.is_signing = self._signer.has_key
            self._signer.continue_chain(self._rows.database)
            self._begin_run(waits_for_disk=waits_for_disk)
        except BaseException:
            self._lock_of_folder.release()
            raise
        self._marked_at_ns = time.monotonic_ns()
        self._reserve.reserve()

    @property
    def trouble(self) -> str:
        """Why the last row could not be written; "" when all are."""
        return self._rows.trouble

    @property
    def lost(self) -> str:
        """The reason why written rows will not be in the folder; "" if they will."""
        if not self._lock_of_folder.is_held:
            return ""
        if not self._lock_of_folder.is_in_place:
            return f"its folder was renamed, deleted or replaced; {_BEGIN_ANEW}"
        if not self._rows.is_in_place:
            return f"the file was renamed, deleted or replaced; {_BEGIN_ANEW}"
        return ""

    def add(
        self, estimate: LengthEstimate, *, iou: float | None = None, flags: Sequence[str] = ()
    ) -> None:
        """Write a final estimate durably; `flags`: warnings for readers of this length.

        `iou`: median over its accepted frames, of mesh and mask.
        """
        catch = {name: getattr(estimate, name) for name in LATER_COLUMNS}
        row = fish_row(estimate, flags) | {"iou": iou} | catch
        self.append(FISH, str(estimate.track_id), row)

    def reserve_track(self, track_id: int) -> None:
        """Mark an id as used, durably: no later run in this folder uses it again."""
        if track_id > self._used.track_id:
            self._mark(track_id=track_id)

    def frame_passed(self, *, frame_index: int, timestamp_ns: int) -> None:
        """Mark a frame: its number durably at once, its capture time within seconds."""
        self.last_ns = timestamp_ns
        is_due = time.monotonic_ns() - self._marked_at_ns > MARK_EVERY_NS
        if is_due or frame_index > self._used.frame_index:
            self._marked_at_ns = time.monotonic_ns()
            self._mark(frame_index=frame_index + _FRAMES_AHEAD, timestamp_ns=timestamp_ns)

    def count_frames(self, promised: int | None) -> None:
        """Count the frames that are done from now on, of as many as the source promises."""
        self._facts = replace(self._facts, frames_done=0, frames_promised=promised)

    def frame_done(self) -> None:
        """A frame went through the whole chain; durable with the next fish or mark."""
        with self._lock:
            self._facts = replace(self._facts, frames_done=(self._facts.frames_done or 0) + 1)

    def end(self, ended_by: str, *, promised: int | None = None) -> None:
        """Write what ended the run, before `close`; `promised`: if that is known only now."""
        promised = self._facts.frames_promised if promised is None else promised
        self._facts = replace(self._facts, ended_by=ended_by, frames_promised=promised)
        last_ns = max(self._used.timestamp_ns, self.last_ns)
        self._used = replace(self._used, timestamp_ns=last_ns)

    def clip_progress(self, name: str, *, frames_done: int) -> None:
        """Mark how far a clip is measured; durable with the next fish or mark.

        So a restart neither repeats a finished fish nor begins the clip again.
        """
        with self._lock:
            if self._clip is not None and self._clip[0] != name:
                self._rows.pending.append((_CLIP, (*self._clip, 1)))
            self._clip = name, frames_done

    def clip_done(self, name: str) -> None:
        """Mark a clip that needs no measuring; durable likewise."""
        with self._lock:
            self._rows.pending.append((_CLIP, (name, 0, 1)))

    def clips_before(self) -> tuple[set[str], dict[str, int]]:
        """The clips that earlier runs have finished, and the frames done of others."""
        clips = list(rows(self._rows.database, CLIPS))
        done = {clip["name"] for clip in clips if clip["is_done"]}
        return done, {c["name"]: c["frames_done"] for c in clips if not c["is_done"]}

    def clock_behind_s(self) -> float:
        """By how much this run's start lies before an earlier run's start or end; else 0."""
        runs = list(rows(self._rows.database, RUNS))
        times = [run[name] or 0 for run in runs for name in ("started_ns", "ended_ns")]
        began = [run["started_ns"] for run in runs if run["run_id"] == self.run_id]
        return (max(times) - began[0]) / 1e9 if began else 0.0

    def was_cut_off(self) -> bool:
        """True if a crash ended the run before this one.

        What ended without a frame is no run: a start that was refused, or lengths that `recover`
        took over.
        """
        before = [run for run in rows(self._rows.database, RUNS) if run["run_id"] != self.run_id]
        runs = [run for run in before if run["ended_ns"] is None or run["frames_done"]]
        return bool(runs) and runs[-1]["ended_ns"] is None

    def resume_after_ns(self) -> int:
        """The capture time after which a live source continues, for any setting of the clock."""
        mark_ns = self.before.timestamp_ns
        return mark_ns if time.time_ns() > mark_ns else mark_ns + MARK_EVERY_NS

    @property
    def calibration_sha256(self) -> str:
        """SHA-256 of the calibration file; "" without a calibration."""
        return self._facts.calibration_sha256

    def scene(self) -> bytes | None:
        """The static scene (see `DriftAlarms`) when this run's calibration was first used here."""
        query = "SELECT data FROM scenes WHERE calibration_sha256 = ?"
        row = self._rows.database.execute(query, (self._facts.calibration_sha256,)).fetchone()
        return None if row is None else row[0]

    def keep_scene(self, data: bytes) -> None:
        key = self._facts.calibration_sha256
        with self._lock:
            self._rows.write(("INSERT OR IGNORE INTO scenes VALUES (?, ?)", (key, data)))

    def first_ious(self, count: int) -> list[float]:
        """The IoU of the first `count` fish here with this run's calibration and template."""
        query = (
            "SELECT iou FROM fish JOIN runs USING (run_id) "
            "WHERE calibration_sha256 = ? AND template_sha256 = ? AND iou IS NOT NULL "
            "ORDER BY number LIMIT ?"
        )
        of_run = self._facts.calibration_sha256, self._facts.template_sha256
        rows = self._rows.database.execute(query, (*of_run, count))
        return [iou for (iou,) in rows]

    def note(self, kind: str, text: str, *, timestamp_ns: int) -> None:
        self.append(EVENTS, kind, {"kind": kind, "text": text, "timestamp_ns": timestamp_ns})

    def append(
        self, table: Table, name: str, values: Mapping[str, object], *, is_urgent: bool = True
    ) -> None:
        """Add a row of this run to a table, signed by `name`.

        Not `is_urgent`: it is durable with the next fish or mark.
        """
        row = {"run_id": self.run_id, **values, "written_ns": time.time_ns()}
        with self._lock:
            signature = self._signer.row(table.kind, name, row)
            self._rows.pending += [insertion(table, row), *signature]
            if is_urgent:
                self._rows.write()

    def sign_file(self, kind: str, name: str, sha256: str) -> None:
        """Sign a file of the folder by its hash, durably; nothing without a signer."""
        with self._lock:
            self._rows.write(*self._signer.content(kind, name, sha256))

    def signed_files(self) -> set[str]:
        """The names of all files that were ever signed here."""
        query = "SELECT DISTINCT name FROM chain WHERE kind IN (?, ?, ?)"
        with self._lock:
            return {name for (name,) in self._rows.database.execute(query, FILE_KINDS)}

    def estimates(self, *, last: int | None = None) -> list[LengthEstimate]:
        """The finished fish of this folder, in the order in which tracks ended.

        `last`: only so many of them, the last.
        """
        with self._querying() as database:
            (count,) = database.execute("SELECT MAX(number) FROM fish").fetchone()
            return read_estimates(database, after=(count or 0) - last if last else None)

    def track_ids(self) -> set[int]:
        """The ids of the finished fish of this folder."""
        with self._querying() as database:
            return set(column_values(database, FISH, "track_id"))

    def rows(self, table: Table, *, after: int) -> list[dict[str, Any]]:
        """The rows of a table whose number is higher, also those of other programs."""
        with self._querying() as database:
            return list(rows(database, table, after=after))

    @contextmanager
    def _querying(self) -> Generator[sqlite3.Connection]:
        with self._lock:
            try:
                yield self._rows.database
            except sqlite3.Error as error:
                raise OutputError(
                    f"{self.path}: expected a database of lengths, got: {error}; make room, or "
                    "choose another --out"
                ) from error

    def flags(self) -> dict[int, list[str]]:
        """The flags of the fish that have some, by track id."""
        query = "SELECT track_id, flags FROM fish WHERE flags != '[]'"
        with self._lock:
            return {i: json.loads(flags) for i, flags in self._rows.database.execute(query)}

    def flags_of(self, track_id: int) -> list[str]:
        """The flags of a finished fish; none if it is not there."""
        query = "SELECT flags FROM fish WHERE track_id = ?"
        with self._lock:
            row = self._rows.database.execute(query, (track_id,)).fetchone()
        return [] if row is None else json.loads(row[0])

    def counts(self, column: Literal["status", "species_code", "fate"]) -> dict[str, int]:
        """The number of finished fish by the value of a column, without fish that have none."""
        query = f"SELECT {column}, COUNT(*) FROM fish WHERE {column} NOT NULL GROUP BY {column}"
        with self._lock:
            return dict(self._rows.database.execute(query))

    def close(self) -> None:
        """End the run and leave one file. Idempotent.

        Raises OutputError if rows could not be written, or are not in the folder.
        """
        if not self._lock_of_folder.is_held:
            return
        lost = self.lost
        values = {"ended_ns": time.time_ns()}
        values |= {name: getattr(self._facts, name) for name in END_COLUMNS if name not in values}
        with self._lock:
            self._rows.write(*self._signed_state())
            signature = self._signer.row(END, self.run_id, {"run_id": self.run_id} | values)
            self._rows.write((_END, (*values.values(), self.run_id)), *signature)
        self._rows.close()
        self._reserve.release()
        self._lock_of_folder.release()
        if lost:
            raise OutputError(f"{self.path}: expected the results of this run, but {lost}")
        if self.trouble:
            raise OutputError(
                f"{self.path}: expected room for {len(self._rows.pending)} more rows, got: "
                f"{self.trouble}; keep a copy of lengths.csv, make room and run stream-dmr "
                "recover, which takes over the fish that the disk let into the recording"
            )

    def _signed_state(self) -> list[Statement]:
        """Statements that sign the rest of the file, once all of it is written."""
        self._rows.write()
        if not self.is_signing or self.trouble:
            return []
        state, checks = read_state(self._rows.database), check_lines(self._rows.database)
        return [
            *self._signer.row(STATE, self.run_id, state),
            *self._signer.content(CHECKS.kind, str(len(checks)), lines_sha256(checks)),
        ]

    def _begin_run(self, *, waits_for_disk: bool) -> None:
        values = {"run_id": self.run_id, "started_ns": time.time_ns()}
        values |= {field.name: getattr(self._facts, field.name) for field in fields(self._facts)}
        begun = {k: v for k, v in values.items() if k not in END_COLUMNS}
        signature = self._signer.row(RUNS.kind, self.run_id, begun)
        self._rows.pending += [insertion(RUNS, values), *signature]
        if self._rows.is_reached:
            self._rows.write()
            if self.trouble and not waits_for_disk:
                raise OutputError(
                    f"{self.path}: expected a database of lengths to write to, got: "
                    f"{self.trouble}; make room, or choose another --out"
                )

    def _mark(self, **marks: int) -> None:
        with self._lock:
            higher = {n: max(v, getattr(self._used, n)) for n, v in marks.items()}
            self._used = replace(self._used, **higher)
            self._rows.write()

    def _state(self) -> Iterator[Statement]:
        """Statements that every commit adds: the present clip, frames done, used numbers."""
        if self._clip is not None:
            yield _CLIP, (*self._clip, 0)
        yield _COUNTS, (self._facts.frames_done, self._facts.frames_promised, self.run_id)
        for field in fields(self._used):
            yield MARK, (field.name, getattr(self._used, field.name))


def _marks(database: sqlite3.Connection) -> Marks:
    """The used numbers; ids that reviewers gave to added and split fish are used as well."""
    values = {"track_id": 0} | dict(database.execute("SELECT name, value FROM marks"))
    reviewed = values.pop(REVIEWED_ID, 0)
    values.pop(WRITTEN, None)
    return Marks(**values | {"track_id": max(values["track_id"], reviewed)})
