"""Verifies the signatures of a folder: the ledger's chain, and every row and file against it."""

import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from stream_dmr.errors import OutputError
from stream_dmr.evidence.seal import CONTINUED
from stream_dmr.evidence.seal import NAME as PROVENANCE
from stream_dmr.evidence.verify_folder import Row, guarded, utc
from stream_dmr.files import is_locked, sha256_of
from stream_dmr.store.ledger import (
    END,
    FILE_KINDS,
    FOUND,
    REMOVED,
    STATE,
    ChainEntry,
    content_sha256,
    is_entry,
    lines_sha256,
)
from stream_dmr.store.run_facts import END_COLUMNS, NOT_ENDED
from stream_dmr.store.schema import (
    CHECKS,
    EVENTS,
    FISH,
    HAULS,
    LEDGER,
    POSITIONS,
    RUNS,
    WATCHED,
    Table,
    check_lines,
    open_for_reading,
    read_state,
    rows,
)
from stream_dmr.store.schema import NAME as DATABASE
from stream_dmr.store.verdicts import read_verdicts


class SignatureCheck(NamedTuple):
    """The findings of one folder."""

    changes: list[str]
    crashes: list[str]  # losses at the end, by a crash or by somebody who cut it off
    notes: list[str]  # further facts for readers


def check_signatures(folder: Path, key: Ed25519PublicKey) -> SignatureCheck:
    """Check the chain of a folder's lengths.db, and everything in the folder against it."""
    check = SignatureCheck([], [], [])
    try:
        database = open_for_reading(folder / DATABASE)
    except OutputError as error:
        check.changes.append(f"its signatures can't be read: {error}")
        return check
    with closing(database):
        entries = list[ChainEntry]()
        _extend(check.changes, "its chain", _whole_entries(database, entries))
        if not entries:
            check.changes.append("nothing in it is signed")
            return check
        signed = _Signed(folder, database, entries)
        for found, name, lines in (
            (check.changes, "its chain", _broken_links(entries, key)),
            (check.changes, "its fish", _rows_by_name(signed, FISH, rows(database, FISH))),
            (check.changes, "its events", _events(signed)),
            (check.changes, "its runs", _runs(signed)),
            (check.crashes, "its last run", _last_run(signed)),
            (check.changes, "its files", _files(signed)),
            (check.changes, "its marks, clips or scenes", _signature_state(signed)),
            (check.changes, "its checks of the scale", _checks(signed)),
            *(
                (check.changes, f"its {table.name}", _added(signed, table))
                for table in (POSITIONS, WATCHED, HAULS)
            ),
            (check.notes, "its events of hauls", _hauls_of_people(signed)),
            (check.notes, "its files", _noted_files(signed)),
            (check.notes, "its checks of the scale", _later_checks(signed)),
            (check.notes, "its verdicts", _unsigned_verdicts(folder / DATABASE)),
        ):
            _extend(found, name, lines)
    last = entries[-1]
    count = f"{len(entries)} signed entries, the last of {utc(last.time_ns)}"
    check.notes.append(f"{count}: {last.sha256[:16]}")
    return check


class _Signed(NamedTuple):
    """The signed entries of a folder, and its content."""

    folder: Path
    database: sqlite3.Connection
    entries: Sequence[ChainEntry]

    def of(self, *kinds: str) -> list[ChainEntry]:
        return [entry for entry in self.entries if entry.kind in kinds]

    def hashes(self, kind: str) -> dict[str, str]:
        """The last hash by name."""
        return {entry.name: entry.content_sha256 for entry in self.of(kind)}

    def unfinished_run(self) -> ChainEntry | None:
        """The begin of the last run, if its end is not signed."""
        last = next(reversed(self.of(RUNS.kind)), None)
        return last if last and last.name not in self.hashes(END) else None


def _extend(found: list[str], name: str, lines: Iterable[str]) -> None:
    found.extend(guarded(lines, lambda why: f"{name} can't be checked: {why}"))


def _whole_entries(database: sqlite3.Connection, entries: list[ChainEntry]) -> Iterator[str]:
    """Add the entries to `entries`; damaged entries are findings instead."""
    for row in rows(database, LEDGER):
        if is_entry(row):
            entries.append(ChainEntry(**row))
        else:
            yield "signed entry {number!r} ({kind!r} {name!r}) is damaged".format(**row)


def _added(signed: _Signed, table: Table) -> Iterator[str]:
    """Rows changed, removed or put in, a line each kind; people may add hauls to a folder."""
    missing, surplus = _unmatched(signed, table)
    if missing:
        yield f"{missing} of its {table.name} are missing, or not as they were signed"
    if surplus and table is not HAULS:
        yield f"{surplus} of its {table.name} were put in, or are not as they were signed"


def _hauls_of_people(signed: _Signed) -> Iterator[str]:
    if surplus := _unmatched(signed, HAULS)[1]:
        yield f"{surplus} events of hauls are not signed by the device"


def _unmatched(signed: _Signed, table: Table) -> tuple[int, int]:
    """The number of rows that were signed and are not there, and that are there and not signed."""
    known = Counter(entry.content_sha256 for entry in signed.of(table.kind))
    found = Counter(map(_content, rows(signed.database, table)))
    return (known - found).total(), (found - known).total()


def _unsigned_verdicts(database: Path) -> Iterator[str]:
    """Each verdict: reviewers have no keys, so anybody who can write to the file can add one."""
    for number, verdict in enumerate(read_verdicts(database), start=1):
        length = "" if verdict.length_mm is None else f" to {verdict.length_mm} mm"
        by = f"{utc(verdict.written_ns)} by {verdict.reviewer!r}"
        what = f"{verdict.kind} fish {verdict.track_id}{length}"
        yield f"verdict {number} of {by}: {what}; not signed"


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


def _rows_by_name(signed: _Signed, table: Table, stored: Iterable[Row]) -> Iterator[str]:
    """Rows changed, removed, put in or moved, by their names in the entries."""
    kind, hashes = table.kind, signed.hashes(table.kind)
    column = "run_id" if table is RUNS else "track_id"
    contents = [(str(row[column]), _content(row)) for row in stored]
    found = dict(contents)
    if len(found) < len(contents):
        yield f"{len(contents) - len(found)} {kind} are there twice"
    for name, sha256 in hashes.items():
        if name not in found:
            yield f"{kind} {name} is missing, and was signed"
        elif found[name] != sha256:
            yield f"{kind} {name} is not as it was signed"
    yield from (f"{kind} {name} is not signed" for name in found if name not in hashes)
    if [name for name in found if name in hashes] != [name for name in hashes if name in found]:
        yield f"the order of the {kind} is not as it was signed"


def _events(signed: _Signed) -> Iterator[str]:
    stored = list(rows(signed.database, EVENTS))
    known = [entry.content_sha256 for entry in signed.of(EVENTS.kind)]
    found = [_content(row) for row in stored]
    all_known, all_found = set(known), set(found)
    for row, sha256 in zip(stored, found, strict=True):
        if sha256 not in all_known:
            yield f"the event {row['text']!r} was put in, or is not as it was signed"
    if missing := len([sha256 for sha256 in known if sha256 not in all_found]):
        yield f"{missing} events are missing, or not as they were signed"
    if not missing and sorted(found) == sorted(known) and found != known:
        yield "the order of the events is not as it was signed"
    if len(found) > len(all_found):
        yield "an event is there twice"


def _runs(signed: _Signed) -> Iterator[str]:
    stored = list(rows(signed.database, RUNS))
    begun = ({k: v for k, v in row.items() if k not in END_COLUMNS} for row in stored)
    yield from _rows_by_name(signed, RUNS, begun)
    ends = signed.hashes(END)
    for row in stored:
        name = str(row["run_id"])
        if name in ends:
            end = {column: row.get(column) for column in END_COLUMNS}
            if content_sha256({"run_id": name} | end) != ends[name]:
                yield f"the end of run {name} is not as it was signed"
        elif row["ended_by"] != NOT_ENDED or row["ended_ns"] is not None:
            yield f"the end of run {name} is not signed"


def _last_run(signed: _Signed) -> Iterator[str]:
    if (last := signed.unfinished_run()) and not is_locked(signed.folder):
        yield f"run {last.name} has no end: it crashed, or what came last was removed"


def _signature_state(signed: _Signed) -> Iterator[str]:
    """Changes of marks, clips and scenes since the last run, if it came to its end."""
    state, last = content_sha256(read_state(signed.database)), signed.of(RUNS.kind, STATE)
    if last and last[-1].kind == STATE and last[-1].content_sha256 != state:
        yield "its marks, clips or scenes are not as they were signed"


def _checks(signed: _Signed) -> Iterator[str]:
    """Changes of the checks of the scale: each run signs the checks known at its end."""
    checks, known = check_lines(signed.database), signed.of(CHECKS.kind)
    if any(lines_sha256(checks[: int(entry.name)]) != entry.content_sha256 for entry in known):
        yield "the checks of the scale are not as they were signed"


def _later_checks(signed: _Signed) -> Iterator[str]:
    known = max((int(entry.name) for entry in signed.of(CHECKS.kind)), default=0)
    if (more := len(check_lines(signed.database)) - known) > 0:
        yield f"checks of the scale that are not signed yet: {more}"


def _files(signed: _Signed) -> Iterator[str]:
    known = {entry.name: entry for entry in signed.of(*FILE_KINDS)}
    unfinished = signed.unfinished_run()
    for name, entry in known.items():
        path = signed.folder / Path(name).name
        if unfinished and name in CONTINUED and entry.number < unfinished.number:
            continue  # it has rows of that run now; each is compared with the fish and segments
        if not path.is_file():
            if entry.kind != REMOVED:
                yield f"{name} is missing, and was signed"
        elif entry.kind == REMOVED or sha256_of(path) != entry.content_sha256:
            yield f"{name} is not as it was signed"
    for path in sorted(_recordings(signed.folder)):
        if path.name not in known:
            yield f"{path.name} is not signed"


def _recordings(folder: Path) -> set[Path]:
    """What other commands take for recordings: views alone only where there is no .mcap."""
    return {*folder.glob("*.mcap")} or {*folder.glob("*.rrd")}


def _noted_files(signed: _Signed) -> Iterator[str]:
    """Files that were found, and others without a signature than recordings (see `_files`)."""
    for entry in signed.of(FOUND):
        yield f"{entry.name} was signed when a run found it, after a crash or renamed"
    known = {entry.name for entry in signed.of(*FILE_KINDS)}
    own = _recordings(signed.folder)
    own |= {path for name in (f"{DATABASE}*", PROVENANCE) for path in signed.folder.glob(name)}
    names = sorted(
        path.name
        for path in signed.folder.iterdir()
        if path.is_file() and path.name not in known and path not in own
    )
    if names:  # exports, maybe
        yield f"not signed by the device: {', '.join(map(repr, names))}"


def _content(row: Row) -> str:
    return content_sha256({name: value for name, value in row.items() if name != "number"})
