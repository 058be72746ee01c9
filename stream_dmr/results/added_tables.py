"""Tables of lengths.db to which a run only adds rows, made where they are missing."""

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stream_dmr.errors import OutputError
from stream_dmr.results.lengths_database import open_for_reading
from stream_dmr.results.sql import has_table, rows_of


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
