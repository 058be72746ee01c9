"""What the chain of signatures says of a folder: found with the device's public key alone."""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from stream_dmr.errors import OutputError
from stream_dmr.files import is_locked, sha256_of
from stream_dmr.results.added_tables import added_rows
from stream_dmr.results.chain_table import read_chain
from stream_dmr.results.hauls import HAULS, WATCHED
from stream_dmr.results.kept_positions import POSITIONS
from stream_dmr.results.lengths_database import NAME as DATABASE
from stream_dmr.results.lengths_database import open_for_reading
from stream_dmr.results.run_facts import END_COLUMNS, NOT_ENDED
from stream_dmr.results.signatures import (
    CHECKS,
    END,
    EVENT,
    FILE_KINDS,
    FISH,
    FOUND,
    REMOVED,
    RUN,
    STATE,
    ChainEntry,
    content_sha256,
    lines_sha256,
)
from stream_dmr.results.signed_files import RECORDINGS
from stream_dmr.results.sql import rows_of
from stream_dmr.results.store_state import check_lines, read_state
from stream_dmr.results.verify_added import added_changes, unsigned_rows

_Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class SignatureCheck:
    """What was found in one folder."""

    changes: list[str] = field(default_factory=list[str])
    notes: list[str] = field(default_factory=list[str])  # what a reader must know beside


def check_signatures(folder: Path, key: Ed25519PublicKey) -> SignatureCheck:
    """Check the chain of a folder's lengths.db, and everything in the folder against it."""
    check = SignatureCheck()
    try:
        with closing(open_for_reading(folder / DATABASE)) as database:
            entries = read_chain(database)
            added = {table: added_rows(database, table) for table in (POSITIONS, WATCHED, HAULS)}
            tables = {name: _rows(database, name) for name in ("runs", "fish", "events")}
            state, checks = content_sha256(read_state(database)), check_lines(database)
    except (sqlite3.Error, OutputError, TypeError) as error:
        check.changes.append(f"its signatures can't be read: {error}")
        return check
    if not entries:
        check.changes.append("nothing in it is signed")
        return check
    check.changes.extend(_broken_links(entries, key))
    check.changes.extend(_rows_by_name(entries, FISH, tables["fish"], "track_id"))
    check.changes.extend(_events(entries, tables["events"]))
    for table, rows in added.items():
        told = unsigned_rows(entries, table, rows) if table is HAULS else 0
        if told:  # people may add hauls to a folder
            check.notes.append(f"{told} events of hauls are not signed by the device")
        check.changes.extend(added_changes(entries, table, rows, may_be_added=table is HAULS))
    check.changes.extend(_runs(entries, tables["runs"], is_going_on=is_locked(folder)))
    check.changes.extend(_files(entries, folder))
    check.changes.extend(_state(entries, state))
    check.changes.extend(_checks(entries, checks))
    check.notes.extend(_found(entries))
    check.notes.extend(_later_checks(entries, checks))
    last = entries[-1]
    when = datetime.fromtimestamp(last.time_ns / 1e9, UTC).isoformat(timespec="seconds")
    check.notes.append(f"{len(entries)} signed entries, the last of {when}: {last.sha256[:16]}")
    return check


def _rows(database: sqlite3.Connection, table: str) -> list[_Row]:
    order = "started_ns" if table == "runs" else "number"
    return list(rows_of(database, f"SELECT * FROM {table} ORDER BY {order}"))


def _broken_links(entries: Sequence[ChainEntry], key: Ed25519PublicKey) -> Iterator[str]:
    previous, number = "", 0
    for entry in entries:
        if entry.number != number + 1:
            yield f"signed entries {number + 1} to {entry.number - 1} are missing"
        elif entry.previous != previous:
            yield f"signed entry {entry.number} does not follow the one before it"
        if not entry.is_signed_by(key):
            yield f"signed entry {entry.number} ({entry.kind} {entry.name}) is not of this key"
        previous, number = entry.sha256, entry.number


def _rows_by_name(
    entries: Sequence[ChainEntry], kind: str, rows: Sequence[_Row], column: str
) -> Iterator[str]:
    """Rows that were changed, removed, put in or moved."""
    signed = {entry.name: entry.content_sha256 for entry in entries if entry.kind == kind}
    found = {str(row[column]): _content(row) for row in rows}
    for name, sha256 in signed.items():
        if name not in found:
            yield f"{kind} {name} is missing, and was signed"
        elif found[name] != sha256:
            yield f"{kind} {name} is not as it was signed"
    yield from (f"{kind} {name} is not signed" for name in found if name not in signed)
    order = [name for name in found if name in signed]
    if order != [name for name in signed if name in found]:
        yield f"the order of the {kind} is not as it was signed"


def _events(entries: Sequence[ChainEntry], rows: Sequence[_Row]) -> Iterator[str]:
    signed = [entry.content_sha256 for entry in entries if entry.kind == EVENT]
    found = [_content(row) for row in rows]
    for row, sha256 in zip(rows, found, strict=True):
        if sha256 not in signed:
            yield f"the event {row['text']!r} was put in, or is not as it was signed"
    if missing := len([sha256 for sha256 in signed if sha256 not in found]):
        yield f"{missing} events are missing, or not as they were signed"
    if not missing and sorted(found) == sorted(signed) and found != signed:
        yield "the order of the events is not as it was signed"
    if len(found) > len(set(found)):
        yield "an event is there twice"


def _runs(
    entries: Sequence[ChainEntry], rows: Sequence[_Row], *, is_going_on: bool
) -> Iterator[str]:
    begun = [{k: v for k, v in row.items() if k not in END_COLUMNS} for row in rows]
    yield from _rows_by_name(entries, RUN, begun, "run_id")
    ends = {entry.name: entry.content_sha256 for entry in entries if entry.kind == END}
    runs = [entry.name for entry in entries if entry.kind == RUN]
    for row in rows:
        name = str(row["run_id"])
        if name in ends:
            end = {column: row.get(column) for column in END_COLUMNS}
            if content_sha256({"run_id": name} | end) != ends[name]:
                yield f"the end of run {name} is not as it was signed"
        elif row["ended_by"] != NOT_ENDED or row["ended_ns"] is not None:
            yield f"the end of run {name} is not signed"
        elif runs and name == runs[-1] and not is_going_on:
            yield f"run {name} has no end: it crashed, or what came last was removed"


def _state(entries: Sequence[ChainEntry], state: str) -> Iterator[str]:
    """Marks, clips and scenes as the last run left them, where it came to its end."""
    last = [entry for entry in entries if entry.kind in (RUN, STATE)]
    if last and last[-1].kind == STATE and last[-1].content_sha256 != state:
        yield "its marks, clips or scenes are not as they were signed"


def _checks(entries: Sequence[ChainEntry], checks: Sequence[str]) -> Iterator[str]:
    """The checks of the scale: each run signs those that were there at its end."""
    for entry in entries:
        if entry.kind == CHECKS and lines_sha256(checks[: int(entry.name)]) != entry.content_sha256:
            yield "the checks of the scale are not as they were signed"
            return


def _later_checks(entries: Sequence[ChainEntry], checks: Sequence[str]) -> Iterator[str]:
    signed = max((int(entry.name) for entry in entries if entry.kind == CHECKS), default=0)
    if more := len(checks) - signed:
        yield f"checks of the scale that are not signed yet: {more}"


def _files(entries: Sequence[ChainEntry], folder: Path) -> Iterator[str]:
    signed = {e.name: e for e in entries if e.kind in FILE_KINDS}
    for name, entry in signed.items():
        path = folder / Path(name).name
        if not path.is_file():
            if entry.kind != REMOVED:
                yield f"{name} is missing, and was signed"
        elif entry.kind == REMOVED or sha256_of(path) != entry.content_sha256:
            yield f"{name} is not as it was signed"
    for pattern in RECORDINGS:
        for path in sorted(folder.glob(pattern)):
            if path.name not in signed:
                yield f"{path.name} is not signed"


def _found(entries: Sequence[ChainEntry]) -> Iterator[str]:
    for entry in entries:
        if entry.kind == FOUND:
            yield f"{entry.name} was signed when a run found it, after a crash or renamed"


def _content(row: _Row) -> str:
    return content_sha256({name: value for name, value in row.items() if name != "number"})
