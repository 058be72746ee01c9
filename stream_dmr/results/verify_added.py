"""Rows of the tables that are only added to, against provenance.json and the signatures."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from stream_dmr.results.added_tables import AddedTable
from stream_dmr.results.finished_fish import rows_by_run
from stream_dmr.results.log_sums import begins_as
from stream_dmr.results.provenance import haul_lines
from stream_dmr.results.signatures import ChainEntry, content_sha256, lines_sha256


def added_changes(
    entries: Sequence[ChainEntry],
    table: AddedTable,
    rows: Sequence[Mapping[str, Any]],
    *,
    may_be_added: bool = False,
) -> Iterator[str]:
    """What was changed, removed or, unless it `may_be_added`, put in; a line each kind."""
    signed = Counter(entry.content_sha256 for entry in entries if entry.kind == table.kind)
    found = Counter(content_sha256(row) for row in rows)
    if missing := (signed - found).total():
        yield f"{missing} of its {table.name} are missing, or not as they were signed"
    surplus = 0 if may_be_added else unsigned_rows(entries, table, rows)
    if surplus:
        yield f"{surplus} of its {table.name} were put in, or are not as they were signed"


def unsigned_rows(
    entries: Sequence[ChainEntry], table: AddedTable, rows: Sequence[Mapping[str, Any]]
) -> int:
    """The number of rows that the device did not sign."""
    signed = Counter(entry.content_sha256 for entry in entries if entry.kind == table.kind)
    return (Counter(content_sha256(row) for row in rows) - signed).total()


def unsealed_rows(database: Path, made: Mapping[str, Any]) -> Iterator[str]:
    """Positions, watched times and hauls that are not as provenance.json, `made`, knows them.

    An older one knows none of them. Raises OutputError.
    """
    tables: tuple[Literal["positions", "watched"], ...] = ("positions", "watched")
    for table in tables:
        sealed: dict[str, str] | None = made.get(f"{table}_sha256")
        if sealed is None:
            continue
        found = rows_by_run(database, table)
        for run_id in {**sealed, **found}:
            if lines_sha256(found.get(run_id, [])) != sealed.get(run_id, lines_sha256([])):
                yield f"the rows of {table} of run {run_id} are not those that it wrote"
    known: dict[str, Any] | None = made.get("hauls")
    lines = haul_lines(database)
    if known is not None and not begins_as(lines, known):
        yield "the hauls are not those that were told"
    elif known is not None and len(lines) > known["count"]:
        yield f"hauls that no run and no `haul` took: {len(lines) - known['count']}"
