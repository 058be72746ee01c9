"""Adds hauls to the results of a folder, beside a run or after it."""

import time
from pathlib import Path

from stream_dmr.errors import UserError
from stream_dmr.files import is_locked
from stream_dmr.results.added_tables import read_added
from stream_dmr.results.finished_fish import database_of, read_runs
from stream_dmr.results.hauls import (
    END,
    HAULS,
    add_haul,
    haul_at,
    haul_values,
    hauls_of,
    next_name,
)
from stream_dmr.results.provenance import seal_hauls
from stream_dmr.sensors.sensors_settings import utc_ns_of

_MAX_SECONDS = 9e9  # what 64 bits of nanoseconds hold: the year 2255


def write_haul(folder: Path, what: str, *, name: str, at: str | None, said_by: str) -> str:
    """Begin or end a haul; returns its name. `at` as in `stream-dmr haul`. Raises UserError."""
    database = database_of(folder)
    if database is None:
        raise UserError(
            f"{folder}: expected the --out of a run, found no lengths.db; check the path"
        )
    hauls = hauls_of(read_added(database, HAULS))
    timestamp_ns = _timestamp_ns(folder, database, at)
    if what == END:
        name = haul_at(hauls, timestamp_ns)
        if not name:
            raise UserError(
                f"{folder}: expected a haul that goes on at that time, got none; begin one first"
            )
    name = name.strip() or next_name(hauls)
    add_haul(database, haul_values(what, name, timestamp_ns, said_by))
    if not is_locked(folder):
        seal_hauls(folder)
    return name


def _timestamp_ns(folder: Path, database: Path, at: str | None) -> int:
    """A time of the user on the clock of the frames."""
    seconds = _seconds(at)
    if seconds is not None:
        return round(seconds * 1e9)
    zeros = [facts.utc_zero_ns for facts in read_runs(database).values()]
    zero_ns = zeros[-1] if zeros else None
    if at is None and not is_locked(folder):
        raise UserError(f"{folder}: no run goes on here; say when, with --at")
    if zero_ns is None:
        raise UserError(
            f"{folder}: its run does not know the time of day of its frames; give --at in seconds, "
            "as in lengths.csv"
        )
    try:
        return (time.time_ns() if at is None else utc_ns_of(at)) - zero_ns
    except ValueError as error:
        raise UserError(f"--at: expected {error}") from error


def _seconds(at: str | None) -> float | None:
    """`at` as seconds; None where it is no number. Raises UserError where it is no time."""
    try:
        seconds = float(at or "")
    except ValueError:
        return None
    if not abs(seconds) < _MAX_SECONDS:
        raise UserError(f"--at: expected seconds as in lengths.csv, got {at}")
    return seconds
