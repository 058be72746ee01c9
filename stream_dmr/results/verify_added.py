"""Rows of the tables that runs only add to, against the chain of signatures."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from stream_dmr.results.added_tables import AddedTable
from stream_dmr.results.signatures import ChainEntry, content_sha256


def added_changes(
    entries: Sequence[ChainEntry], table: AddedTable, rows: Sequence[Mapping[str, Any]]
) -> Iterator[str]:
    """What was changed, removed or put in, a line each kind."""
    signed = Counter(entry.content_sha256 for entry in entries if entry.kind == table.kind)
    found = Counter(content_sha256(row) for row in rows)
    if missing := (signed - found).total():
        yield f"{missing} of its {table.name} are missing, or not as they were signed"
    if surplus := unsigned_rows(entries, table, rows):
        yield f"{surplus} of its {table.name} were put in, or are not as they were signed"


def unsigned_rows(
    entries: Sequence[ChainEntry], table: AddedTable, rows: Sequence[Mapping[str, Any]]
) -> int:
    """The number of rows that the device did not sign."""
    signed = Counter(entry.content_sha256 for entry in entries if entry.kind == table.kind)
    return (Counter(content_sha256(row) for row in rows) - signed).total()
