"""Verifies that results are as their run measured them: every file against its inputs.

The recording attests the database and frames.csv, the database lengths.csv, and provenance.json
all of them. A consistent change of all can't be found here: keep a copy of provenance.json
elsewhere.
"""

import csv
import io
import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from stream_dmr.errors import OutputError, RecordingError, UserError
from stream_dmr.evidence.seal import NAME as PROVENANCE
from stream_dmr.evidence.seal import (
    RECORDINGS,
    begins_as,
    haul_lines,
    known_files,
    log_sum,
    read_provenance,
    verdict_lines,
)
from stream_dmr.files import is_locked, sha256_of
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.recording.reading import decoded_messages, open_recordings
from stream_dmr.recording.selection import EVERYTHING
from stream_dmr.store.edits import (
    TrackEdits,
    edited_row,
    edits_of,
    frames_of_parts,
    frames_of_tracks,
    settings_of,
)
from stream_dmr.store.fish import (
    FishResult,
    database_of,
    read_measured_fish,
    read_runs,
    rows_by_run,
    run_times,
)
from stream_dmr.store.ledger import (
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
    read_chain,
)
from stream_dmr.store.run_facts import END_COLUMNS, NOT_ENDED, RunFacts, run_facts
from stream_dmr.store.run_tables import FRAMES_COLUMNS, LENGTHS_COLUMNS, frames_row, lengths_row
from stream_dmr.store.schema import NAME as DATABASE
from stream_dmr.store.schema import (
    AddedTable,
    added_rows,
    check_lines,
    open_for_reading,
    read_state,
    rows_of,
)
from stream_dmr.store.trip import HAULS, POSITIONS, WATCHED
from stream_dmr.store.verdicts import Verdict, frames_sha256, read_added_frames, read_verdicts
from stream_dmr.tables import rotated_files

_NOT_COMPUTED = ("flags",)


def changed_edits(database: Path, measured: Sequence[FishResult]) -> Iterator[str]:
    """What is not as reviewers made it, one line each. Raises OutputError."""
    verdicts = read_verdicts(database)
    yield from _added_frames(database, verdicts)
    edits = edits_of(verdicts)
    if edits.fish:
        try:
            yield from _lengths(database, edits, measured)
        except RecordingError as error:
            yield f"fish that reviewers made can't be checked: {error}"


def _added_frames(database: Path, verdicts: Sequence[Verdict]) -> Iterator[str]:
    frames = read_added_frames(database)
    said = {one.track_id: one.frames_sha256 for one in verdicts if one.kind == "add"}
    for track_id in sorted(frames.keys() | said.keys()):
        if frames_sha256(frames.get(track_id, [])) != said.get(track_id):
            yield f"fish {track_id}: its frames are not those that a reviewer added"


def _lengths(database: Path, edits: TrackEdits, measured: Sequence[FishResult]) -> Iterator[str]:
    """Compare each fish with what its frames give, where the recording still has them all."""
    recording = open_recordings([database.parent])
    settings = settings_of(recording)
    tracks = {part.track_id for one in edits.fish.values() for part in one.parts}
    last = {one.estimate.track_id: one.estimate.last_frame for one in measured}
    frames = frames_of_tracks(recording, database, tracks, last)
    for track_id, edited in edits.fish.items():
        try:
            chosen = frames_of_parts(frames, edited.parts, fish=track_id)
        except UserError:
            yield f"fish {track_id}: its tracks are in view together"
            continue
        if len(chosen) < edited.row["frames_seen"] and any(database.parent.glob("recording-*")):
            continue  # the oldest segments of a camera are deleted where room is short
        expected = edited_row(chosen, settings, ()) if chosen else {}
        for name, now in edited.row.items():
            if name not in _NOT_COMPUTED and now != expected.get(name):
                yield f"fish {track_id}: {name} is {now}, its frames give {expected.get(name)}"


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


_MADE_BY = ("config_sha256", "calibration_sha256", "template_sha256")
_COMPARED = (
    *("length_mm", "length_std_mm", "frames_seen", "frames_used", "first_frame", "last_frame"),
    *("first_timestamp_ns", "last_timestamp_ns", "status"),
)


Checks = Mapping[str, Callable[[Path], Iterable[tuple[Path, str]]]]
"""By the file that a folder has: what is found there, each with the file that it concerns."""


class Change(NamedTuple):
    """One file, run or fish that was changed after it was written."""

    path: Path
    what: str


def verify(folder: Path, others: Checks = MappingProxyType({})) -> tuple[list[Change], int]:
    """Check a folder of results or exports and those in it; what was changed, and files checked.

    `others` are checks of folders that hold a file of that name. Raises UserError where there is
    nothing to check.
    """
    marks = (DATABASE, PROVENANCE, *others)
    places = {path.parent for name in marks for path in folder.rglob(name)}
    if not places:
        raise UserError(
            f"{folder}: expected a folder with {DATABASE} or {PROVENANCE}, found neither; give the "
            "--out of a run or of an export"
        )
    changes, num_files = list[Change](), 0
    for place in sorted(places):
        changes += dict.fromkeys(_changes(place, others))
        num_files += sum(1 for path in place.iterdir() if path.is_file())
        num_files += sum(1 for _ in place.glob("dataset/*/*/*/*.parquet"))
    return changes, num_files


def _changes(folder: Path, others: Checks) -> Iterator[Change]:
    yield from _against_provenance(folder)
    for name, check in others.items():
        if (folder / name).is_file():
            yield from (Change(*finding) for finding in check(folder))
    database = database_of(folder)
    if database is None:
        return
    try:
        runs = read_runs(database)
        fish = {one.estimate.track_id: one for one in read_measured_fish(database)}
    except OutputError as error:
        yield Change(database, f"damaged: {error}")
        return
    yield from (Change(database, line) for line in changed_edits(database, list(fish.values())))
    lengths = {
        str(track_id): lengths_row(one.estimate, may_count_twice=one.may_count_twice)
        for track_id, one in fish.items()
    }
    yield from _csv(folder / "lengths.csv", LENGTHS_COLUMNS, lengths, witness=DATABASE, whole=True)
    frames: dict[str, list[str]] = {}
    for recording in _recordings(folder):
        yield from _recording(recording, runs, fish, frames)
    if frames:
        yield from _csv(
            folder / "frames.csv", FRAMES_COLUMNS, frames, witness="the recording", whole=False
        )


def _recordings(folder: Path) -> list[Path]:
    """Those to be read: every .mcap, and an .rrd, which is slow to read, where nothing knows it."""
    known = known_files(folder)
    rrd = [path for path in folder.glob("*.rrd") if path.name not in known]
    return sorted([*folder.glob("*.mcap"), *folder.glob("*.mcap.part"), *rrd])


def _against_provenance(folder: Path) -> Iterator[Change]:
    try:
        made = read_provenance(folder)
    except (ValueError, OSError) as error:
        yield Change(folder / PROVENANCE, f"damaged: {error}")
        return
    if made is None:
        yield Change(folder / PROVENANCE, "is missing; files were compared with each other alone")
        return
    for name, expected in made["files"].items():
        path = folder / name
        if not path.is_file():
            yield Change(path, "is missing")
        elif sha256_of(path) != expected:
            yield Change(path, f"was changed: its SHA-256 is not that in {PROVENANCE}")
    database = database_of(folder)
    if database is not None:
        yield from _surplus_tables(folder, made["files"])
        yield from _database(database, made)


def _surplus_tables(folder: Path, known: Collection[str]) -> Iterator[Change]:
    """Tables that nothing of stream-dmr wrote, though their names may look like it."""
    tables = {path for path in folder.glob("*.csv") if path.name not in known}
    if not any(name.endswith((".mcap", ".rrd")) for name in known):  # a camera's are rotated
        tables -= set(rotated_files(folder / "frames.csv"))
    for path in sorted(tables):
        yield Change(path, "is no table of this run")


def _database(database: Path, made: dict[str, Any]) -> Iterator[Change]:
    """The fish and the runs against provenance.json."""
    try:
        stored, runs = rows_by_run(database, "fish"), read_runs(database)
        events, times = rows_by_run(database, "events"), run_times(database)
        said = verdict_lines(database)
    except OutputError:
        return  # `_changes` says so
    for run_id, expected in made["fish_sha256"].items():
        if lines_sha256(stored.get(run_id, [])) != expected:
            yield Change(database, f"the fish of run {run_id} are not those that were measured")
    for run_id, known in made.get("run_times_ns", {}).items():  # older ones have neither of these
        if times.get(run_id) != known:
            yield Change(database, f"run {run_id}: its times are not those of its run")
        expected = made["events_sha256"].get(run_id)
        if events.get(run_id) and expected is None:
            yield Change(database, f"run {run_id}: events were put in")
        elif expected is not None and lines_sha256(events.get(run_id, [])) != expected:
            yield Change(database, f"the events of run {run_id} are not those that were noted")
    for what in unsealed_rows(database, made):
        yield Change(database, what)
    for run_id, facts in made["runs"].items():
        for column in fields(RunFacts):
            now = getattr(runs.get(run_id), column.name, "missing")
            was = facts.get(column.name, column.default)  # older ones have fewer
            if now != was:
                yield Change(database, f"run {run_id}: {column.name} is {now!r}, was {was!r}")
    yield from _verdicts(database, said, made.get("verdicts") or log_sum([]))
    yield from _state(database, made, is_of_last_run=set(runs) == set(made["runs"]))


def _state(database: Path, made: dict[str, Any], *, is_of_last_run: bool) -> Iterator[Change]:
    """The other tables against provenance.json, which older ones don't sum up."""
    known = made.get("checks")
    if known is None:
        return
    with closing(open_for_reading(database)) as connection:
        state, checks = content_sha256(read_state(connection)), check_lines(connection)
    if not begins_as(checks, known):
        yield Change(database, "the checks of the scale are not those that were made")
    if is_of_last_run and state != made["state_sha256"]:
        yield Change(database, "its marks, clips or scenes are not as its last run left them")


def _verdicts(database: Path, said: Sequence[str], known: dict[str, Any]) -> Iterator[Change]:
    """The verdicts against provenance.json: rows are only added."""
    if not begins_as(said, known):
        yield Change(database, "the verdicts are not those that reviewers gave")
    elif len(said) > known["count"]:
        yield Change(database, f"verdicts that no `review` took: {len(said) - known['count']}")


def _recording(
    path: Path,
    runs: dict[str, RunFacts],
    fish: dict[int, FishResult],
    frames: dict[str, list[str]],
) -> Iterator[Change]:
    """Compare a recording with the database; its rows of frames.csv are added to `frames`."""
    try:
        recording = open_recordings([path])
        made = run_facts(recording.header)
        if not any(all(getattr(r, n) == getattr(made, n) for n in _MADE_BY) for r in runs.values()):
            of_run = next(iter(runs.values()), None)
            for name in _MADE_BY:
                if getattr(of_run, name, None) != getattr(made, name):
                    yield Change(path, f"{name} is {getattr(made, name)}, no run in {DATABASE} has")
        waiting: dict[tuple[int, int], LocalizedFish] = {}
        for message, _ in decoded_messages(recording, [LocalizedFish, LengthEstimate], EVERYTHING):
            key = message.frame_index, getattr(message, "track_id", 0)
            if isinstance(message, LocalizedFish):
                waiting[key] = message
            elif isinstance(message, LengthEstimate):
                if (seen := waiting.pop(key, None)) is not None:
                    row = frames_row(seen, message.is_frame_used, message.frame_reason)
                    frames[f"{key[0]},{key[1]}"] = row
                if message.is_final:
                    yield from _estimate(path, message, fish.get(message.track_id))
        for line in recording.warnings:
            yield Change(path, line.removeprefix(f"{path}: "))
    except RecordingError as error:
        yield Change(path, f"damaged: {str(error).removeprefix(f'{path}: ')}")


def _estimate(path: Path, recorded: LengthEstimate, fish: FishResult | None) -> Iterator[Change]:
    database = path.parent / DATABASE
    if fish is None:
        yield Change(database, f"fish {recorded.track_id} is missing; {path.name} has it")
        return
    compared = [(name, getattr(fish.estimate, name)) for name in _COMPARED]
    for name, stored in [*compared, *asdict(fish.catch).items()]:
        measured = getattr(recorded, name)
        if stored != measured:
            what = f"fish {recorded.track_id}: {name} is {stored}, {path.name} says {measured}"
            yield Change(database, what)


def _csv(
    path: Path,
    columns: Sequence[str],
    expected: dict[str, list[str]],
    *,
    witness: str,
    whole: bool,
) -> Iterator[Change]:
    """Compare a table with rows of a witness; it may have more rows, unless it is `whole`."""
    if not path.is_file():
        yield Change(path, "is missing")
        return
    found: dict[str, list[str]] = {}
    for table in (older := rotated_files(path)) + [path]:
        rows = _rows(table, columns)
        if rows is None:
            yield Change(table, "its columns are not those of stream-dmr")
            return
        found |= rows
    # Where room was short the oldest tables went, maybe with some rows of the first frame left.
    first = min((int(row[0]) for row in found.values()), default=0) if older else 0
    for name, row in expected.items():
        if older and int(row[0]) <= first:
            continue
        label = "frame {}, fish {}".format(*name.split(",")) if "," in name else f"fish {name}"
        if name not in found:
            yield Change(path, f"{label} is missing; {witness} has it")
            continue
        for column, now, was in zip(columns, found[name], row, strict=True):
            if now != was:
                cell = f"{column} is {now or 'blank'}, {witness} says {was or 'blank'}"
                yield Change(path, f"{label}: {cell}")
    for name in sorted(found.keys() - expected.keys()) if whole else ():
        yield Change(path, f"fish {name} is no fish of {witness}")


def _rows(path: Path, columns: Sequence[str]) -> dict[str, list[str]] | None:
    """Rows by their fish, or by frame and fish; None where the columns are others."""
    rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8", errors="replace"))))
    if not rows or rows[0] != list(columns):
        return None
    fish = columns.index("track_id")
    whole = [row for row in rows[1:] if len(row) == len(columns)]
    return {f"{row[0]},{row[fish]}" if fish else row[0]: row for row in whole}


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
            tables = {name: _signed_rows(database, name) for name in ("runs", "fish", "events")}
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
    check.changes.extend(_signature_state(entries, state))
    check.changes.extend(_checks(entries, checks))
    check.notes.extend(_found(entries))
    check.notes.extend(_later_checks(entries, checks))
    last = entries[-1]
    when = datetime.fromtimestamp(last.time_ns / 1e9, UTC).isoformat(timespec="seconds")
    check.notes.append(f"{len(entries)} signed entries, the last of {when}: {last.sha256[:16]}")
    return check


def _signed_rows(database: sqlite3.Connection, table: str) -> list[_Row]:
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


def _signature_state(entries: Sequence[ChainEntry], state: str) -> Iterator[str]:
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
