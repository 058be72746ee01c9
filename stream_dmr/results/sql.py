"""Statements and questions that every table of a lengths.db needs."""

import sqlite3
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import MISSING, fields
from typing import Any, get_args, get_type_hints

_KINDS: dict[Any, str] = {str: "TEXT", int: "INTEGER", float: "REAL"}

Statement = tuple[str, tuple[object, ...]]
"""SQL, and the values of its marks."""


@contextmanager
def transaction(database: sqlite3.Connection) -> Generator[None]:
    """All that is executed within is written, or nothing of it where any of it raises."""
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            database.execute("ROLLBACK")
        raise


def insertion(table: str, values: Mapping[str, object]) -> Statement:
    """The statement that adds a row; `values` by column."""
    marks = ", ".join("?" for _ in values)
    return f"INSERT INTO {table} ({', '.join(values)}) VALUES ({marks})", tuple(values.values())


def rows_of(
    database: sqlite3.Connection, query: str, values: tuple[object, ...] = ()
) -> Iterator[dict[str, Any]]:
    """The rows that a query finds, by column."""
    found = database.execute(query, values)
    names = [column[0] for column in found.description]
    return (dict(zip(names, row, strict=True)) for row in found)


def has_table(database: sqlite3.Connection, name: str) -> bool:
    """True where there is a table of this name."""
    query = "SELECT 1 FROM sqlite_master WHERE name = ? AND type = 'table'"
    return database.execute(query, (name,)).fetchone() is not None


def add_columns(database: sqlite3.Connection, table: str, columns: Mapping[str, str]) -> None:
    """Add the columns (name -> type) that a table of an earlier version lacks."""
    present = columns_of(database, table)
    for name, kind in columns.items():
        if name not in present:
            database.execute(f"ALTER TABLE {table} ADD COLUMN {name} {kind}")


def optional_columns(facts: type) -> dict[str, str]:
    """The columns (name -> type) for the fields with a default: of str, int, float, or None."""
    hints = get_type_hints(facts)
    names = [field.name for field in fields(facts) if field.default is not MISSING]
    return {name: _KINDS[(get_args(hints[name]) or (hints[name],))[0]] for name in names}


def declaration(columns: Mapping[str, str]) -> str:
    """The columns as CREATE TABLE takes them."""
    return ", ".join(f"{name} {kind}" for name, kind in columns.items())


def columns_of(database: sqlite3.Connection, table: str) -> set[str]:
    """The names of a table's columns; none where there is no such table."""
    return {column[1] for column in database.execute(f"PRAGMA table_info({table})")}
