"""Read finished fish with their run, haul, position, species and review."""

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate, Position
from stream_dmr.recording.header import RunInputs
from stream_dmr.recording.reading import Recording, messages_of, recorded_settings
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.sources.sensors_settings import SensorsSettings
from stream_dmr.species import CODE, UNSURE, Species, find_species, load_species
from stream_dmr.store.edits import TrackPart, edits_of
from stream_dmr.store.run_facts import UNKNOWN_CATCH, CatchFacts, RunFacts, cut_short, run_facts
from stream_dmr.store.scale_checks import last_checks
from stream_dmr.store.schema import (
    MAY_COUNT_TWICE,
    NAME,
    added_rows,
    estimate_of,
    has_table,
    open_for_reading,
    read_estimates,
    rows_of,
)
from stream_dmr.store.trip import (
    HAULS,
    NOWHERE,
    POSITIONS,
    VesselTrack,
    Whereabouts,
    haul_at,
    hauls_of,
    kept_of,
    positions_of,
)
from stream_dmr.store.verdicts import (
    NOT_COUNTED,
    NOT_REVIEWED,
    Review,
    Verdict,
    read_verdicts,
    reviews_of,
)
from stream_dmr.template.template import load_body_forms

_CATCH_NAMES = [field.name for field in fields(CatchFacts)]


@dataclass(frozen=True, eq=False, kw_only=True)
class FishResult:
    """One finished fish."""

    estimate: LengthEstimate
    facts: RunFacts
    run_id: str  # "": of a recording without its database
    iou: float | None = None
    flags: Sequence[str] = ()
    catch: CatchFacts = UNKNOWN_CATCH
    haul: str = ""
    where: Whereabouts = NOWHERE  # at `middle_ns`
    review: Review = NOT_REVIEWED
    origin: str = "run"  # or the edit of a reviewer that made it: add, split or merge

    @property
    def counts(self) -> bool:
        """True unless a reviewer rejected it, or said that another fish stands for it."""
        return self.review.decision not in NOT_COUNTED

    @property
    def middle_ns(self) -> int:
        """The capture time halfway between its first and its last frame."""
        return middle_ns(self.estimate)

    @property
    def utc_ns(self) -> int | None:
        """UTC at `middle_ns`: the receiver's, or by the time of the frames; None: unknown."""
        if self.where.utc_ns is not None or self.facts.utc_zero_ns is None:
            return self.where.utc_ns
        return self.middle_ns + self.facts.utc_zero_ns

    @property
    def may_count_twice(self) -> bool:
        """True where it was in view at a crash, and maybe again after it."""
        return any(MAY_COUNT_TWICE in flag for flag in self.flags)

    @property
    def fate(self) -> str | None:
        """The reviewer's, else that of the zones."""
        return self.catch.fate if self.review.fate is None else self.review.fate

    @property
    def length_mm(self) -> float | None:
        """The length that a reviewer corrected, else the measured one."""
        corrected = self.review.length_mm
        return self.estimate.length_mm if corrected is None else corrected


class _Folder:
    """What the fish of a lengths.db have in common: runs, hauls and the vessel's track."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self.runs = dict(_runs(connection))
        self._hauls = hauls_of(added_rows(connection, HAULS))
        self._track = VesselTrack(positions_of(added_rows(connection, POSITIONS)))

    def fish(self, estimate: LengthEstimate, run_id: str, **values: Any) -> FishResult:
        """A fish of a run, with its haul and its place."""
        facts, moment_ns = self.runs[run_id], middle_ns(estimate)
        return FishResult(
            estimate=estimate,
            facts=facts,
            run_id=run_id,
            haul=haul_at(self._hauls, moment_ns) if self._hauls else facts.haul,
            where=self._track.at(moment_ns),
            **values,
        )


def middle_ns(estimate: LengthEstimate) -> int:
    """Halfway between the capture times of a fish's first and last frame."""
    return (estimate.first_timestamp_ns + estimate.last_timestamp_ns) // 2


def database_of(path: Path) -> Path | None:
    """The lengths.db of a folder; None without one."""
    database = path / NAME
    return database if path.is_dir() and database.is_file() else None


def read_fish(
    path: Path, recording: Recording, selection: Selection = EVERYTHING
) -> list[FishResult]:
    """The fish of a folder from its lengths.db, or from the recording where it has none.

    Raises OutputError or RecordingError where they can't be read.
    """
    database = database_of(path)
    if database is not None:
        fish = read_stored_fish(database)
        return [
            one
            for one in fish
            if selection.includes(one.estimate)
            and selection.includes_time(one.estimate.last_timestamp_ns)
        ]
    facts, track = run_facts(recording.header), recorded_track(recording)
    return [
        FishResult(
            estimate=estimate,
            facts=facts,
            run_id="",
            catch=CatchFacts.of(estimate),
            where=track.at(middle_ns(estimate)),
        )
        for estimate in messages_of(recording, LengthEstimate, selection)
        if estimate.is_final
    ]


def recorded_track(recording: Recording) -> VesselTrack:
    """The vessel's track of a recording, as its run's settings cut it at gaps."""
    settings = recorded_settings(recording, "sensors", SensorsSettings)
    positions = messages_of(recording, Position)
    return VesselTrack(kept_of(positions, keep_s=settings.keep_s, max_gap_s=settings.max_gap_s))


def read_stored_fish(database: Path) -> list[FishResult]:
    """All fish of a lengths.db as reviewed: with those that were added, split and merged.

    A fish that was merged into another stays, with that decision. Raises OutputError where the
    file is damaged.
    """
    verdicts = read_verdicts(database)
    return _with_edits(database, _stored_fish(database, reviews_of(verdicts)), verdicts)


def read_measured_fish(database: Path) -> list[FishResult]:
    """All fish of a lengths.db as they were measured, without any review. OutputError likewise."""
    return _stored_fish(database, {})


def _with_edits(
    database: Path, measured: Sequence[FishResult], verdicts: Sequence[Verdict]
) -> list[FishResult]:
    """The fish with those that reviewers made; each is of the run of its first frames."""
    edits, reviews = edits_of(verdicts), reviews_of(verdicts)
    if not edits.fish:
        return list(measured)
    with closing(open_for_reading(database)) as connection:
        folder = _Folder(connection)
    tracks = {one.estimate.track_id: one for one in measured}
    fish = dict(tracks)
    for track_id, edited in edits.fish.items():
        parts = sorted(edited.parts, key=lambda part: (part.last_frame, part.first_frame))
        runs = [tracks[part.track_id].run_id for part in parts if part.track_id in tracks]
        fish[track_id] = folder.fish(
            estimate_of(edited.row),
            runs[0] if runs else list(folder.runs)[-1],
            iou=edited.row["iou"],
            flags=json.loads(edited.row["flags"]),
            catch=_catch_of(parts, tracks),
            review=reviews.get(track_id, NOT_REVIEWED),
            origin=edited.kind,
        )
    return list(fish.values())


def _catch_of(parts: Sequence[TrackPart], tracks: Mapping[int, FishResult]) -> CatchFacts:
    """Of a fish of several parts of tracks: its fate is that of the track that it ends with."""
    known = [tracks[part.track_id] for part in parts if part.track_id in tracks]
    if not known:
        return UNKNOWN_CATCH
    is_cut = parts[-1].last_frame < known[-1].estimate.last_frame
    last = UNKNOWN_CATCH if is_cut else known[-1].catch
    return replace(known[0].catch, fate=last.fate, fate_share=last.fate_share)


def read_runs(database: Path) -> dict[str, RunFacts]:
    """The facts of the runs by run id, in their order. Raises OutputError."""
    with closing(open_for_reading(database)) as connection:
        return dict(_runs(connection))


def run_notes(path: Path) -> list[str]:
    """A line for each run that measured a part of its source, and for each wrong scale.

    Raises OutputError.
    """
    database = database_of(path)
    if database is None:
        return []
    runs, checks = read_runs(database), last_checks(database)
    used = {facts.calibration_sha256 for facts in runs.values()}
    alarms = [c.alarm for sha256, c in checks.items() if c.alarm and sha256 in used]
    return [*(line for facts in runs.values() if (line := cut_short(facts))), *alarms]


def numbers_its_own(folder: Path) -> bool:
    """True where a run in a folder was given no ids of its fish. Raises OutputError."""
    database = database_of(folder)
    runs = {} if database is None else read_runs(database)
    texts = [{k: v for k, v in asdict(f).items() if isinstance(v, str)} for f in runs.values()]
    given = [RunInputs.from_facts(facts) for facts in texts]
    return any(inputs is not None and not (inputs.boxes or inputs.masks) for inputs in given)


def run_times(database: Path) -> dict[str, list[int | None]]:
    """When each run began and ended, ns of the wall clock."""
    with closing(open_for_reading(database)) as connection:
        rows = connection.execute("SELECT run_id, started_ns, ended_ns FROM runs")
        return {run_id: [started, ended] for run_id, started, ended in rows}


def rows_by_run(
    database: Path, table: Literal["fish", "events", "positions", "watched"]
) -> dict[str, list[str]]:
    """Every stored value of the rows of each run, as lines of JSON, for checksums.

    `CatchFacts` only where they have a value, by name: older databases lack their columns.
    """
    lines: dict[str, list[str]] = {}
    with closing(open_for_reading(database)) as connection:
        if not has_table(connection, table):
            return {}
        for row in rows_of(connection, f"SELECT * FROM {table} ORDER BY number"):
            added = {name: row.pop(name, None) for name in _CATCH_NAMES}
            facts = {name: value for name, value in added.items() if value is not None}
            line = [*row.values(), *([facts] if facts else [])]
            lines.setdefault(row["run_id"], []).append(json.dumps(line, default=repr))
    return lines


def flagged_fish(out_dir: Path) -> set[int]:
    """The ids of fish whose length has a flag. Raises OutputError where they can't be read."""
    path = out_dir / NAME
    if not path.exists():
        return set()
    try:
        with closing(open_for_reading(path)) as connection:
            rows = connection.execute("SELECT track_id FROM fish WHERE flags != '[]'")
            return {track_id for (track_id,) in rows}
    except sqlite3.Error as error:
        raise OutputError(f"{path}: expected the flags of its fish, got: {error}") from error


def _runs(connection: sqlite3.Connection) -> Iterator[tuple[str, RunFacts]]:
    for row in rows_of(connection, "SELECT * FROM runs ORDER BY started_ns"):
        # An older database has fewer columns.
        known = {f.name: row[f.name] for f in fields(RunFacts) if row.get(f.name) is not None}
        yield row["run_id"], RunFacts(**known)


def _stored_fish(database: Path, reviews: dict[int, Review]) -> list[FishResult]:
    try:
        with closing(open_for_reading(database)) as connection:
            folder = _Folder(connection)
            estimates = read_estimates(connection)
            others = rows_of(connection, "SELECT * FROM fish ORDER BY number")
            return [
                folder.fish(
                    estimate,
                    other["run_id"],
                    iou=other["iou"],
                    flags=json.loads(other["flags"]),
                    catch=CatchFacts(**{name: other.get(name) for name in _CATCH_NAMES}),
                    review=reviews.get(estimate.track_id, NOT_REVIEWED),
                )
                for estimate, other in zip(estimates, others, strict=True)
            ]
    except (sqlite3.Error, ValueError, KeyError) as error:
        raise OutputError(
            f"{database}: expected the fish of its runs, got: {error!r}; the file is damaged"
        ) from error


def species_of(fish: FishResult) -> Species | None:
    """That of the bundled list; None where it is not in there, or nobody knows."""
    return find_species(fish.review.species or fish.catch.species_code or "", load_species())


def code_of(fish: FishResult) -> str | None:
    """FAO 3-alpha: a reviewer may also type one that the list lacks. A classifier's may be unsure.

    None where nobody looked, and for a name without a code.
    """
    named = fish.review.species.strip()
    if not named:
        return fish.catch.species_code
    found = species_of(fish)
    return found.code if found else named if CODE.fullmatch(named) else None


def sure_code(fish: FishResult) -> str:
    """As `code_of`; "" where it is not known or unsure."""
    code = code_of(fish)
    return "" if code is None or code == UNSURE else code


def is_same_species(one: str, other: str) -> bool:
    """True where two texts name one species, by its code, a name, or the template drawn of it."""
    return _species_named(one) == _species_named(other)


@cache
def _species_named(text: str) -> str:
    """The code of the species that a text names, else the text, whatever its capitals."""
    form = load_body_forms().get(text.strip().casefold())
    scientific_name = None if form is None else form.title.split(", ")[-1]
    found = find_species(scientific_name or text, load_species())
    return found.code if found else text.strip().casefold()
