"""Verifies that results are as their run measured them: every file against its inputs.

The recording attests the database and frames.csv, the database lengths.csv, and provenance.json
all of them. A consistent change of all can't be found here: keep a copy of provenance.json
elsewhere.
"""

import csv
import io
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from stream_dmr.csv_file import rotated_files
from stream_dmr.errors import OutputError, RecordingError, UserError
from stream_dmr.files import sha256_of
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.recording.messages.selection import EVERYTHING
from stream_dmr.recording.reading.open_recording import decoded_messages, open_recordings
from stream_dmr.results.finished_fish import (
    FishResult,
    database_of,
    read_measured_fish,
    read_runs,
    rows_by_run,
    run_times,
)
from stream_dmr.results.frames_table import FRAMES_COLUMNS, frames_row
from stream_dmr.results.lengths_database import NAME as DATABASE
from stream_dmr.results.lengths_database import open_for_reading
from stream_dmr.results.lengths_table import LENGTHS_COLUMNS, lengths_row
from stream_dmr.results.log_sums import begins_as, log_sum
from stream_dmr.results.provenance import NAME as PROVENANCE
from stream_dmr.results.provenance import known_files, read_provenance, verdict_lines
from stream_dmr.results.run_facts import RunFacts, run_facts
from stream_dmr.results.signatures import content_sha256, lines_sha256
from stream_dmr.results.store_state import check_lines, read_state
from stream_dmr.results.verify_added import unsealed_rows
from stream_dmr.results.verify_edits import changed_edits

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
        for field in fields(RunFacts):
            now = getattr(runs.get(run_id), field.name, "missing")
            was = facts.get(field.name, field.default)  # older ones have fewer
            if now != was:
                yield Change(database, f"run {run_id}: {field.name} is {now!r}, was {was!r}")
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
