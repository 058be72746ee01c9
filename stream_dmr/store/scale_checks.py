"""Checks of the scale by a known length; rows are only added."""

import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from stream_dmr.errors import OutputError
from stream_dmr.store.schema import CHECKS, add_row, reading, records

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
        """The warning for readers of lengths; "" if the scale is right."""
        if abs(self.error_percent) <= self.limit_percent:
            return ""
        return (
            f"a known length of {self.known_mm:.1f} mm was measured "
            f"{abs(self.error_percent):.2f} % too {'long' if self.error_percent > 0 else 'short'}, "
            f"more than {self.limit_percent:g} %: all lengths with this calibration have the same "
            "error"
        )


class ScaleAlarm:
    """The alarm of the last check of a calibration, for a run that continues beside `check`."""

    def __init__(
        self, database: Path, calibration_sha256: str, *, read_every_s: float = _READ_EVERY_S
    ) -> None:
        self._database, self._calibration_sha256 = database, calibration_sha256
        self._read_every_s = read_every_s
        self._line, self._read_s = "", -np.inf

    def line(self) -> str:
        """The problem of the scale; "" if it has none, or nothing was checked."""
        if time.monotonic() - self._read_s >= self._read_every_s:
            self._read_s = time.monotonic()
            with suppress(OutputError):  # a database that can't be read is a problem of its own
                check = last_checks(self._database).get(self._calibration_sha256)
                self._line = check.alarm if check else ""
        return self._line


def add_check(database: Path, check: ScaleCheck) -> None:
    """Write a check into a lengths.db, durably. Raises OutputError."""
    add_row(database, CHECKS, asdict(replace(check, time_ns=time.time_ns())))


def last_checks(database: Path) -> dict[str, ScaleCheck]:
    """The last check by the SHA-256 of its calibration. Raises OutputError."""
    with reading(database) as connection:
        checks = records(connection, CHECKS, ScaleCheck)
    return {check.calibration_sha256: check for check in checks}
