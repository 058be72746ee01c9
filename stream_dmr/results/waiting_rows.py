"""WaitingRows: writes rows of a lengths.db that may have to wait until the disk takes them."""

import sqlite3
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from stream_dmr.errors import OutputError
from stream_dmr.results.lengths_database import DiskRefusal, copy_in_memory, open_for_writing
from stream_dmr.results.reserved_space import ReservedSpace
from stream_dmr.results.sql import Statement, transaction

MARK = "INSERT INTO marks VALUES (?1, ?2) ON CONFLICT (name) DO UPDATE SET value = ?2"
WRITTEN = "written"
"""The mark of how many statements were committed: a commit that failed may have been one."""
_GET_WRITTEN = "SELECT value FROM marks WHERE name = ?"


class WaitingRows:
    """Statements for a lengths.db, in order, and its connection. Not thread-safe.

    What the disk refuses stays in memory and is tried again with everything that follows; meanwhile
    a copy of the file in memory answers questions.
    """

    def __init__(
        self,
        path: Path,
        reserve: ReservedSpace,
        *,
        waits_for_disk: bool,
        state: Callable[[], Iterable[Statement]],
    ) -> None:
        """`state` is what every commit writes as well, as it is at that moment.

        Raises OutputError where the file can't be used; with `waits_for_disk` only where that is
        not for the disk.
        """
        self._path, self._reserve, self._state = path, reserve, state
        self.pending: list[Statement] = []
        self.trouble = ""  # why the last row could not be written; "" when all are
        self.database, self.is_reached = self._open(waits_for_disk=waits_for_disk)
        self._is_stand_in = not self.is_reached
        self._written = _num_written(self.database)

    def write(self, *statements: Statement) -> None:
        """Commit all that waits, and these; where that fails, with the reserved space once more."""
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

    def close(self) -> None:
        """Close the file; what still waits is lost."""
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
        written = _num_written(fresh)
        del self.pending[: max(0, written - self._written)]
        self._written = written


def _num_written(database: sqlite3.Connection) -> int:
    row = database.execute(_GET_WRITTEN, (WRITTEN,)).fetchone()
    return 0 if row is None else row[0]
