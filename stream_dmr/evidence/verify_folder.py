"""Verifies that results are as their run measured them: every file against its inputs.

The recording attests the database and frames.csv, the database lengths.csv, and provenance.json
all of them. A consistent change of all can't be found here: keep a copy of provenance.json
elsewhere.
"""

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from itertools import takewhile
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from stream_dmr.errors import UserError
from stream_dmr.evidence.seal import (
    CONTINUED,
    begins_as,
    haul_lines,
    known_files,
    log_sum,
    read_provenance,
    verdict_lines,
)
from stream_dmr.evidence.seal import NAME as PROVENANCE
from stream_dmr.evidence.verify_batch import check_batch
from stream_dmr.files import is_locked, sha256_of
from stream_dmr.messages import FittedMesh, Frame, LengthEstimate, LocalizedFish, track_of
from stream_dmr.recording.codec import decode
from stream_dmr.recording.mcap.mcap_recording import is_torn
from stream_dmr.recording.reading import Recording, messages_of, open_recordings
from stream_dmr.recording.repair import DAMAGED
from stream_dmr.recording.selection import Selection
from stream_dmr.recording.topics import TOPICS
from stream_dmr.store.batch_folder import VIDEOS
from stream_dmr.store.edits import (
    ReviewedMessages,
    TrackEdits,
    corrected_fish,
    corrected_length,
    edited_row,
    edits_of,
    frames_of_parts,
    frames_of_tracks,
)
from stream_dmr.store.fish import database_of, read_runs, rows_by_run, run_times
from stream_dmr.store.ledger import content_sha256, lines_sha256
from stream_dmr.store.run_facts import NOT_ENDED, RunFacts, run_facts
from stream_dmr.store.run_tables import FRAMES_COLUMNS, LENGTHS_COLUMNS, frames_row, lengths_row
from stream_dmr.store.schema import (
    ESTIMATE_COLUMNS,
    EVENTS,
    FISH,
    LATER_COLUMNS,
    POSITIONS,
    WATCHED,
    check_lines,
    estimate_of,
    read_rows,
    read_state,
    reading,
)
from stream_dmr.store.schema import NAME as DATABASE
from stream_dmr.store.verdicts import (
    Verdict,
    frames_sha256,
    read_added_frames,
    read_verdicts,
    reviews_after,
)
from stream_dmr.tables import rotated_files

Row = Mapping[str, Any]
_NOT_COMPUTED = ("flags",)

T = TypeVar("T")


def guarded(check: Iterable[T], finding: Callable[[str], T]) -> Iterator[T]:
    """The findings of a check, and `finding` if its files are too broken to continue."""
    try:
        yield from check
    except Exception as error:  # rows and JSON that others wrote may hold anything
        is_ours = isinstance(error, UserError)
        why = str(error) if is_ours else f"{type(error).__name__}: {error}"
        yield finding(" ".join(why.split()))


def changed_edits(database: Path, last_frames: Mapping[int, int]) -> Iterator[str]:
    """Edits that are not as reviewers made them, one line each. Raises OutputError.

    `last_frames` by recorded track.
    """
    verdicts, frames = read_verdicts(database), read_added_frames(database)
    said = {added.track_id: added.frames_sha256 for added in verdicts if added.kind == "add"}
    for track_id in sorted(frames.keys() | said.keys()):
        if frames_sha256(frames.get(track_id, [])) != said.get(track_id):
            yield f"fish {track_id}: its frames are not those that a reviewer added"
    edits = edits_of(verdicts)
    if edits.fish:
        yield from guarded(
            _lengths(database, edits, last_frames),
            lambda why: f"fish that reviewers made can't be checked: {why}",
        )
    corrections = [(n, v) for n, v in enumerate(verdicts, start=1) if v.kind == "correct"]
    if corrections:
        yield from guarded(
            _corrections(database, verdicts, corrections),
            lambda why: f"lengths that reviewers corrected can't be checked: {why}",
        )


def _corrections(
    database: Path, verdicts: Sequence[Verdict], corrections: Sequence[tuple[int, Verdict]]
) -> Iterator[str]:
    """Compute each corrected length again, from all points of its fish that were set until then."""
    recording = open_recordings([database.parent], of_all_runs=True)
    fish = Selection(tracks=frozenset(verdict.track_id for _, verdict in corrections))
    wanted = {(verdict.track_id, verdict.frame_index) for _, verdict in corrections}
    fits = {
        (fit.track_id, fit.frame_index): fit
        for fit in ReviewedMessages(recording, database, fish).of(FittedMesh)
        if (fit.track_id, fit.frame_index) in wanted
    }
    first_ns = _first_left_ns(database, recording)
    reviews = reviews_after(verdicts, [number for number, _ in corrections])
    for (number, verdict), review in zip(corrections, reviews, strict=True):
        name = f"verdict {number}: fish {verdict.track_id}"
        moved = {**review.moved, **verdict.moved}
        missing = [frame for frame in moved if (verdict.track_id, frame) not in fits]
        times = [fits[verdict.track_id, frame].timestamp_ns for frame in moved.keys() - {*missing}]
        if first_ns is not None and (missing or min(times, default=first_ns) < first_ns):
            continue  # as in `_lengths`
        if missing or not verdict.moved:
            yield f"{name} is corrected to {verdict.length_mm} mm by no points in its frames"
            continue
        try:
            frames = {
                frame: corrected_fish(
                    recording, fits[verdict.track_id, frame], np.array(points, float)
                )
                for frame, points in moved.items()
            }
        except UserError as error:
            yield f"{name}: {error}"
            continue
        length = corrected_length(recording, frames)
        for column in ("length_mm", "length_std_mm"):
            now, was = getattr(verdict, column), getattr(length, column)
            if now is None or was is None or not math.isclose(now, was, rel_tol=1e-9):
                yield f"{name}: {column} is {now}, its points give {was}"


def _lengths(database: Path, edits: TrackEdits, last_frames: Mapping[int, int]) -> Iterator[str]:
    """Compare each fish with the length by its frames, if the recording still has them all."""
    recording = open_recordings([database.parent], of_all_runs=True)
    tracks = {part.track_id for fish in edits.fish.values() for part in fish.parts}
    frames = frames_of_tracks(recording, database, tracks, last_frames)
    first_ns = _first_left_ns(database, recording)
    for track_id, edited in edits.fish.items():
        try:
            chosen = frames_of_parts(frames, edited.parts, fish=track_id)
        except UserError:
            yield f"fish {track_id}: its tracks are in view together"
            continue
        is_whole = len(chosen) >= edited.row["frames_seen"]
        if first_ns is not None and not (
            is_whole and chosen and chosen[-1].timestamp_ns >= first_ns
        ):
            continue
        expected = edited_row(recording, chosen, ()) if chosen else {}
        for name, now in edited.row.items():
            if name not in _NOT_COMPUTED and now != expected.get(name):
                yield f"fish {track_id}: {name} is {now}, its frames give {expected.get(name)}"


def _first_left_ns(database: Path, recording: Recording) -> int | None:
    """The time of the first frame that the segments of a camera still have; None for a video.

    Where room is short the oldest are deleted: with frames, and with the settings of fish that
    reviewers added there, whose frames are in the database.
    """
    if not any(database.parent.glob("recording-*")):
        return None
    first = next(messages_of(recording, Frame), None)
    return 0 if first is None else first.timestamp_ns


_MADE_BY = ("config_sha256", "calibration_sha256", "template_sha256")


class Change(NamedTuple):
    """One file, run or fish that is not as its run wrote it, or that its run never finished."""

    path: Path
    what: str
    is_by_crash: bool = False  # a crash explains it; nobody need have changed anything


def verify(folder: Path) -> tuple[list[Change], int]:
    """Check a folder of results, exports or a batch, and the folders in it.

    Returns the changes found, and the number of files checked. Raises UserError if there is nothing
    to check.
    """
    marks = (DATABASE, PROVENANCE, VIDEOS)
    places = {path.parent for name in marks for path in folder.rglob(name)}
    if not places:
        raise UserError(
            f"{folder}: expected a folder with {DATABASE} or {PROVENANCE}, found neither; give the "
            "--out of a run or of an export"
        )
    changes, num_files = list[Change](), 0
    for place in sorted(places):
        changes += dict.fromkeys(_changes(place))
        num_files += sum(1 for path in place.iterdir() if path.is_file())
        num_files += sum(1 for _ in place.glob("dataset/*/*/*/*.parquet"))
    return changes, num_files


def _changes(folder: Path) -> Iterator[Change]:
    """The changes in one folder: the checks are independent, and none stops the next."""
    for path in sorted(folder.iterdir()):
        if not path.is_file() and not path.is_dir():
            yield Change(path, "is no file: a pipe, a device or a link to nothing")
    database = database_of(folder)
    runs: dict[str, RunFacts] = {}
    fish: dict[int, Row] = {}
    lengths: dict[str, list[str]] = {}
    of_rows = [*_broken(database, _stored(database, runs, fish, lengths))] if database else []
    yield from _broken(folder / PROVENANCE, _against_provenance(folder, runs))
    if (folder / VIDEOS).is_file():
        findings = (Change(*finding) for finding in check_batch(folder))
        yield from _broken(folder / VIDEOS, findings)
    if database is None:
        return
    yield from of_rows
    last_frames = {track_id: row["last_frame"] for track_id, row in fish.items()}
    edited = changed_edits(database, last_frames)
    yield from _broken(database, (Change(database, line) for line in edited))
    is_cut = bool(_unfinished_run(runs))
    if runs:
        table = folder / "lengths.csv"
        cuts = [len(lengths)] if is_cut else []
        yield from _csv(table, LENGTHS_COLUMNS, lengths, witness=DATABASE, cuts=cuts)
    frames: dict[str, list[str]] = {}
    cuts = list[int]()
    # Every .mcap, and an .rrd, which is slow to read, only if the provenance doesn't list it.
    known = known_files(folder)
    ends = ("", ".part", f".part{DAMAGED}")
    found = [path for end in ends for path in folder.glob(f"*.mcap{end}")]
    found += [path for path in folder.glob("*.rrd") if path.name not in known]
    for recording in sorted(path for path in found if path.is_file()):
        if recording.suffix == DAMAGED:  # nothing in it was whole when a crash was repaired
            cuts += [len(frames)] if _has_crashed(runs) else []
            continue
        check, is_left = _recording(recording, runs, fish, frames), recording.suffix == ".part"
        findings = list(_broken(recording, check, is_by_crash=is_cut and is_left))
        yield from findings
        if any(change.path == recording and change.is_by_crash for change in findings):
            cuts.append(len(frames))
    if frames:
        table, witness = folder / "frames.csv", "the recording"
        cuts += [len(frames)] if is_cut else []
        yield from _csv(table, FRAMES_COLUMNS, frames, witness=witness, cuts=cuts)


def _broken(path: Path, check: Iterable[Change], *, is_by_crash: bool = False) -> Iterator[Change]:
    def finding(why: str) -> Change:
        return Change(path, f"damaged: {why.removeprefix(f'{path}: ')}", is_by_crash)

    return guarded(check, finding)


def _stored(
    database: Path, runs: dict[str, RunFacts], fish: dict[int, Row], lengths: dict[str, list[str]]
) -> Iterator[Change]:
    """Read `runs`, the rows of `fish`, and theirs of lengths.csv; each broken row is a finding."""
    runs |= read_runs(database)
    going_on = _unfinished_run(runs) if is_locked(database.parent) else ""
    for run_id, facts in runs.items():
        if facts.ended_by == NOT_ENDED:
            what = "goes on" if run_id == going_on else "was interrupted by a crash"
            yield Change(database, f"run {run_id} {what}", is_by_crash=True)
    for row in read_rows(database, FISH):
        track_id = row["track_id"]
        fish[track_id] = row
        try:
            flags = json.loads(row["flags"])
            lengths[str(track_id)] = lengths_row(estimate_of(row), flags)
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            yield Change(database, f"fish {track_id}: its row is damaged: {error!r}")


def _has_crashed(runs: Mapping[str, RunFacts]) -> bool:
    return any(facts.ended_by == NOT_ENDED for facts in runs.values())


def _unfinished_run(runs: Mapping[str, RunFacts]) -> str:
    """The last run, if it has no end: a crash may have cut off the tables, too; else ""."""
    return next((run_id for run_id in [*runs][-1:] if runs[run_id].ended_by == NOT_ENDED), "")


def summary(database: Path) -> Iterator[str]:
    """A line for each run: vessel, source, time and number of fish. Raises OutputError."""
    times, fish = run_times(database), rows_by_run(database, FISH)
    for run_id, facts in read_runs(database).items():
        begun, ended = (utc(ns) for ns in times[run_id])
        yield (
            f"run {run_id}: vessel {facts.vessel!r}, source {facts.source!r}, {begun} to {ended}, "
            f"{len(fish.get(run_id, []))} fish"
        )


def utc(time_ns: int | None) -> str:
    """UTC to the second; "?" if it is unknown or no time."""
    try:
        return datetime.fromtimestamp(int(time_ns or "") / 1e9, UTC).isoformat(timespec="seconds")
    except (ValueError, OverflowError, OSError, TypeError):
        return "?"


def _against_provenance(folder: Path, runs: Mapping[str, RunFacts]) -> Iterator[Change]:
    try:
        made = read_provenance(folder)
    except (ValueError, OSError) as error:
        yield Change(folder / PROVENANCE, f"damaged: {error}")
        return
    unfinished = _unfinished_run(runs)
    if made is None:
        what = "is missing; files were compared with each other alone"
        yield Change(folder / PROVENANCE, what, is_by_crash=bool(unfinished))
        return
    goes_on = bool(unfinished) and unfinished not in made["runs"]
    for name, expected in made["files"].items():
        path = folder / name
        if not path.is_file():
            yield Change(path, "is missing")
        elif sha256_of(path) != expected and not (goes_on and name in CONTINUED):
            yield Change(path, f"was changed: its SHA-256 is not that in {PROVENANCE}")
    database = database_of(folder)
    if database is None:
        return
    # Tables that stream-dmr did not write, though their names may look like it; a camera's
    # frames.csv, whose recordings are not sealed, is rotated.
    tables = {path for path in folder.glob("*.csv") if path.name not in made["files"]}
    if not any(name.endswith((".mcap", ".rrd")) for name in made["files"]):
        tables -= set(rotated_files(folder / "frames.csv"))
    yield from (Change(path, "is no table of this run") for path in sorted(tables))
    for check in (_fish_and_runs, _unsealed_rows, _verdicts, _state):
        lines = guarded(
            check(database, made), lambda why: f"can't be compared with {PROVENANCE}: {why}"
        )
        yield from (Change(database, line) for line in lines)


def _fish_and_runs(database: Path, made: dict[str, Any]) -> Iterator[str]:
    """The fish and the runs against provenance.json."""
    stored = rows_by_run(database, FISH)
    for run_id, expected in made["fish_sha256"].items():
        if lines_sha256(stored.get(run_id, [])) != expected:
            yield f"the fish of run {run_id} are not those that were measured"
    runs, events, times = read_runs(database), rows_by_run(database, EVENTS), run_times(database)
    for run_id, known in made.get("run_times_ns", {}).items():  # older files have neither of these
        if times.get(run_id) != known:
            yield f"run {run_id}: its times are not those of its run"
        expected = made["events_sha256"].get(run_id)
        if events.get(run_id) and expected is None:
            yield f"run {run_id}: events were put in"
        elif expected is not None and lines_sha256(events.get(run_id, [])) != expected:
            yield f"the events of run {run_id} are not those that were noted"
    for run_id, facts in made["runs"].items():
        for column in fields(RunFacts):
            now = getattr(runs.get(run_id), column.name, "missing")
            was = facts.get(column.name, column.default)  # older files have fewer
            if now != was:
                yield f"run {run_id}: {column.name} is {now!r}, was {was!r}"


def _state(database: Path, made: dict[str, Any]) -> Iterator[str]:
    """Compare the other tables with provenance.json; older ones have no sums of them."""
    known = made.get("checks")
    if known is None:
        return
    with reading(database) as connection:
        state, checks = content_sha256(read_state(connection)), check_lines(connection)
    if not begins_as(checks, known):
        yield "the checks of the scale are not those that were made"
    if set(read_runs(database)) == set(made["runs"]) and state != made["state_sha256"]:
        yield "its marks, clips or scenes are not as its last run left them"


def _unsealed_rows(database: Path, made: Mapping[str, Any]) -> Iterator[str]:
    """Compare positions, watched times and hauls with provenance.json; older ones have none."""
    for table in (POSITIONS, WATCHED):
        sealed: dict[str, str] | None = made.get(f"{table.name}_sha256")
        if sealed is None:
            continue
        found = rows_by_run(database, table)
        for run_id in {**sealed, **found}:
            if lines_sha256(found.get(run_id, [])) != sealed.get(run_id, lines_sha256([])):
                yield f"the rows of {table.name} of run {run_id} are not those that it wrote"
    lines, known = haul_lines(database), made.get("hauls")
    if known is not None:
        changed, added = "the hauls are not those that were told", "hauls that no run and no `haul`"
        yield from _log(lines, known, changed=changed, added=added)


def _verdicts(database: Path, made: dict[str, Any]) -> Iterator[str]:
    lines, known = verdict_lines(database), made.get("verdicts") or log_sum([])
    changed, added = "the verdicts are not those that reviewers gave", "verdicts that no `review`"
    yield from _log(lines, known, changed=changed, added=added)


def _log(
    lines: Sequence[str], known: Mapping[str, Any], *, changed: str, added: str
) -> Iterator[str]:
    """A log against its sum in provenance.json: rows are only added, and the sum then renewed."""
    if not begins_as(lines, known):
        yield changed
    elif len(lines) > known["count"]:
        yield f"{added} took: {len(lines) - known['count']}"


def _recording(
    path: Path, runs: dict[str, RunFacts], fish: Mapping[int, Row], frames: dict[str, list[str]]
) -> Iterator[Change]:
    """Compare a recording with the database; its rows of frames.csv are added to `frames`."""
    recording, database = open_recordings([path]), path.parent / DATABASE
    made_by = attrgetter(*_MADE_BY)
    made = made_by(run_facts(recording.header))
    of_runs = [made_by(facts) for facts in runs.values()]
    if of_runs and made not in of_runs:
        for name, now, was in zip(_MADE_BY, made, of_runs[0], strict=True):
            if now != was:
                yield Change(path, f"{name} is {now}, no run in {DATABASE} has")
    waiting: dict[tuple[int, int], LocalizedFish] = {}
    for kind, payload in recording.payloads([*TOPICS]):  # all kinds: up to its last byte
        if kind not in (LocalizedFish, LengthEstimate):
            continue
        message = decode(kind, payload)
        key = message.frame_index, track_of(message)
        if isinstance(message, LocalizedFish):
            waiting[key] = message
        else:
            if (seen := waiting.pop(key, None)) is not None:
                row = frames_row(seen, message.is_frame_used, message.frame_reason)
                frames[f"{key[0]},{key[1]}"] = row
            if not (message.is_final and runs):  # without runs the database can't be read
                continue
            stored, name = fish.get(message.track_id), f"fish {message.track_id}"
            if stored is None:
                yield Change(database, f"{name} is missing; {path.name} has it")
                continue
            for column in (*ESTIMATE_COLUMNS, *LATER_COLUMNS):
                now, was = stored.get(column), getattr(message, column)
                if now != was:
                    yield Change(database, f"{name}: {column} is {now}, {path.name} says {was}")
    # A crash leaves a torn .mcap.part, which is repaired; .mcap is the name of a whole file.
    is_cut_off = path.suffix == ".mcap" and is_torn(path)
    for line in recording.warnings:
        what = line.removeprefix(f"{path}: ")
        yield Change(path, what, is_by_crash=_has_crashed(runs) and not is_cut_off)


def _csv(
    path: Path,
    columns: Sequence[str],
    expected: dict[str, list[str]],
    *,
    witness: str,
    cuts: Iterable[int],
) -> Iterator[Change]:
    """Compare a table with rows of a witness; only frames.csv may have more rows.

    `cuts`: numbers of rows of the witness after which a crash came; the rows right before may be
    missing in the table.
    """
    if not path.is_file():
        yield Change(path, "is missing")
        return
    found: dict[str, list[str]] = {}
    older = [table for table in rotated_files(path) if table.is_file()]
    for table in [*older, path]:
        found_rows = _rows(table, columns)
        if found_rows is None:
            yield Change(table, "its columns are not those of stream-dmr")
            return
        found |= found_rows
    # If room was short the oldest tables were deleted, maybe within the rows of a frame.
    first = min((int(row[0]) for row in found.values()), default=0) if older else 0
    names = [*expected]
    kept_by_crash = {
        name
        for cut in cuts
        for name in takewhile(lambda name: name not in found, names[:cut][::-1])
    }
    for name, row in expected.items():
        if older and int(row[0]) <= first:
            continue
        label = "frame {}, fish {}".format(*name.split(",")) if "," in name else f"fish {name}"
        if name not in found:
            what = f"{label} is missing; {witness} has it"
            yield Change(path, what, is_by_crash=name in kept_by_crash)
            continue
        for column, now, was in zip(columns, found[name], row, strict=True):
            if now != was:
                cell = f"{column} is {now or 'blank'}, {witness} says {was or 'blank'}"
                yield Change(path, f"{label}: {cell}")
    for name in sorted(found.keys() - expected.keys()) if witness == DATABASE else ():
        yield Change(path, f"fish {name} is no fish of {witness}")


def _rows(path: Path, columns: Sequence[str]) -> dict[str, list[str]] | None:
    """Rows by their fish, or by frame and fish; None if the columns differ."""
    table = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8", errors="replace"))))
    if not table or table[0] != list(columns):
        return None
    fish = columns.index("track_id")
    whole = [row for row in table[1:] if len(row) == len(columns)]
    return {f"{row[0]},{row[fish]}" if fish else row[0]: row for row in whole}
