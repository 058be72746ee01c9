"""Checks of the scale by a known length: a table of its own in lengths.db, rows are only added."""

import sqlite3
import time
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from stream_dmr.errors import OutputError
from stream_dmr.store.schema import (
    has_table,
    insertion,
    open_for_reading,
    open_for_writing,
    rows_of,
)

_TABLE = """
CREATE TABLE IF NOT EXISTS checks (
    number INTEGER PRIMARY KEY,
    time_ns INTEGER NOT NULL, -- wall clock
    source TEXT NOT NULL,
    calibration_sha256 TEXT NOT NULL,
    known_mm REAL NOT NULL, error_mm REAL NOT NULL,
    error_percent REAL NOT NULL, worst_percent REAL NOT NULL,
    limit_percent REAL NOT NULL -- an alarm beyond it
) STRICT
"""

_READ_EVERY_S = 5.0  # chosen: /health may be asked several times a second


@dataclass(frozen=True, kw_only=True)
class ScaleCheck:
    """One row: a known length, as it was measured with a calibration."""

    source: str
    calibration_sha256: str
    known_mm: float
    error_mm: float
    error_percent: float  # with its sign
    worst_percent: float
    limit_percent: float
    time_ns: int = 0

    @property
    def alarm(self) -> str:
        """What a reader of lengths must know; "" where the scale is right."""
        if abs(self.error_percent) <= self.limit_percent:
            return ""
        return (
            f"a known length of {self.known_mm:.1f} mm was measured "
            f"{abs(self.error_percent):.2f} % too {'long' if self.error_percent > 0 else 'short'}, "
            f"more than {self.limit_percent:g} %: all lengths with this calibration have the same "
            "error"
        )


_NAMES = [field.name for field in fields(ScaleCheck)]


class ScaleAlarm:
    """The alarm of the last check of a calibration, for a run that goes on beside `check`."""

    def __init__(
        self, database: Path, calibration_sha256: str, *, read_every_s: float = _READ_EVERY_S
    ) -> None:
        self._database, self._calibration_sha256 = database, calibration_sha256
        self._read_every_s = read_every_s
        self._line, self._read_s = "", -np.inf

    def line(self) -> str:
        """What is wrong with the scale; "" where nothing is, or nothing was checked."""
        if time.monotonic() - self._read_s >= self._read_every_s:
            self._read_s = time.monotonic()
            with suppress(OutputError):  # a database that can't be read is a problem of its own
                check = last_checks(self._database).get(self._calibration_sha256)
                self._line = check.alarm if check else ""
        return self._line


def add_check(database: Path, check: ScaleCheck) -> None:
    """Write a check into a lengths.db, durably. Raises OutputError."""
    row = asdict(replace(check, time_ns=time.time_ns()))
    try:
        with closing(open_for_writing(database)) as connection:
            connection.execute(_TABLE)
            connection.execute(*insertion("checks", row))
    except sqlite3.Error as error:
        raise OutputError(f"{database}: expected room for a check, got: {error}") from error


def last_checks(database: Path) -> dict[str, ScaleCheck]:
    """The last check by the SHA-256 of its calibration. Raises OutputError."""
    try:
        with closing(open_for_reading(database)) as connection:
            if not has_table(connection, "checks"):
                return {}
            query = f"SELECT {', '.join(_NAMES)} FROM checks ORDER BY number"
            checks = [ScaleCheck(**row) for row in rows_of(connection, query)]
    except sqlite3.Error as error:
        raise OutputError(f"{database}: expected checks of the scale, got: {error}") from error
    return {check.calibration_sha256: check for check in checks}
