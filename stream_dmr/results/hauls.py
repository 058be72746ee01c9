"""Hauls of a trip: begun and ended by events, which are only added to lengths.db."""

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stream_dmr.errors import OutputError
from stream_dmr.results.added_tables import AddedTable
from stream_dmr.results.lengths_database import open_for_writing
from stream_dmr.results.sql import insertion

START, END = "start", "end"
HAULS = AddedTable(
    name="hauls",
    kind="haul",
    columns="""
    run_id TEXT NOT NULL, -- the run that was told; '': a folder, after its run
    what TEXT NOT NULL, -- start, end
    name TEXT NOT NULL, -- of the haul
    timestamp_ns INTEGER NOT NULL, -- on the clock of the frames
    said_by TEXT NOT NULL, -- who or what said so
    written_ns INTEGER NOT NULL -- wall clock
""",
)
WATCHED = AddedTable(
    name="watched",
    kind="watched",
    columns="""
    run_id TEXT NOT NULL REFERENCES runs,
    first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, -- frames without a pause, capture times
    frames INTEGER NOT NULL, -- that were measured
    frames_lost INTEGER NOT NULL, -- that came from the camera and were not
    written_ns INTEGER NOT NULL -- wall clock
""",
)


@dataclass(frozen=True, kw_only=True)
class Haul:
    """One haul, by its times on the clock of the frames."""

    name: str
    began_ns: int
    ended_ns: int | None = None  # None: it goes on

    def includes(self, timestamp_ns: int) -> bool:
        """True for a time within it."""
        return self.began_ns <= timestamp_ns and (
            self.ended_ns is None or timestamp_ns < self.ended_ns
        )


def hauls_of(rows: Iterable[Mapping[str, Any]]) -> list[Haul]:
    """The hauls that events make, in their order.

    A start ends the haul before it; an end without a start means nothing.
    """
    hauls: list[Haul] = []
    for row in sorted(rows, key=lambda row: row["timestamp_ns"]):
        if hauls and hauls[-1].ended_ns is None:
            last = hauls.pop()
            hauls.append(Haul(name=last.name, began_ns=last.began_ns, ended_ns=row["timestamp_ns"]))
        if row["what"] == START:
            hauls.append(Haul(name=row["name"], began_ns=row["timestamp_ns"]))
    return hauls


def haul_at(hauls: Sequence[Haul], timestamp_ns: int) -> str:
    """The name of the haul at a time; "" between hauls."""
    return next((haul.name for haul in hauls if haul.includes(timestamp_ns)), "")


def next_name(hauls: Iterable[Haul]) -> str:
    """The number of a haul that nobody gives a name: that after the highest so far."""
    numbers = [int(haul.name) for haul in hauls if haul.name.isdecimal()]
    return str(max(numbers, default=0) + 1)


def haul_values(what: str, name: str, timestamp_ns: int, said_by: str) -> dict[str, Any]:
    """The columns of an event, without the run and the time of writing."""
    return {"what": what, "name": name, "timestamp_ns": timestamp_ns, "said_by": said_by}


def add_haul(database: Path, values: Mapping[str, Any]) -> None:
    """Write an event into a lengths.db, durably and not signed. Raises OutputError."""
    row = {"run_id": "", **values, "written_ns": time.time_ns()}
    try:
        with closing(open_for_writing(database)) as connection:
            connection.execute(HAULS.statement)
            connection.execute(*insertion(HAULS.name, row))
    except OSError as error:
        raise OutputError(f"{database}: expected room for a haul, got: {error}") from error
