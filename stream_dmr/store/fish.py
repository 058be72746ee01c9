"""Read finished fish with their run, haul, position, species and review."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate, Position
from stream_dmr.recording.header import RunInputs
from stream_dmr.recording.reading import Recording, header_at, messages_of, recorded_settings
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.sources.sensors_settings import SensorsSettings
from stream_dmr.species import CODE, UNSURE, Species, find_species, load_species
from stream_dmr.store.edits import TrackPart, edits_of
from stream_dmr.store.run_facts import RunFacts, cut_short, run_facts
from stream_dmr.store.scale_checks import last_checks
from stream_dmr.store.schema import (
    FISH,
    HAULS,
    LATER_COLUMNS,
    NAME,
    RUNS,
    Table,
    estimate_of,
    read_rows,
    reading,
    rows,
)
from stream_dmr.store.trip import (
    NOWHERE,
    Haul,
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Fish:
    """A finished fish as measured and reviewed; the review has priority over the measurement.

    Measured length and species are in `estimate`.
    """

    estimate: LengthEstimate
    facts: RunFacts
    run_id: str  # "": of a recording without its database
    iou: float | None = None
    flags: Sequence[str] = ()
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
        return middle_ns(self.estimate)

    @property
    def utc_ns(self) -> int | None:
        """UTC at `middle_ns`: the receiver's, or by the time of the frames; None: unknown."""
        if self.where.utc_ns is not None or self.facts.utc_zero_ns is None:
            return self.where.utc_ns
        return self.middle_ns + self.facts.utc_zero_ns

    @property
    def fate(self) -> str | None:
        """The reviewer's fate, else that of the zones."""
        return self.estimate.fate if self.review.fate is None else self.review.fate

    @property
    def length_mm(self) -> float | None:
        """The length that a reviewer corrected, else the measured length."""
        corrected = self.review.length_mm
        return self.estimate.length_mm if corrected is None else corrected

    @property
    def species(self) -> Species | None:
        """The species of the bundled list; None if it is not in there, or unknown."""
        return _bundled_species(self.review.species or self.estimate.species_code or "")

    @property
    def species_code(self) -> str | None:
        """FAO 3-alpha code, in a review also codes that the list lacks; a classifier may be unsure.

        None if nobody looked, and for a name without a code.
        """
        named = self.review.species.strip()
        if not named:
            return self.estimate.species_code
        return self.species.code if self.species else named if CODE.fullmatch(named) else None

    @property
    def sure_code(self) -> str:
        """`species_code`, but "" if it is not known or unsure."""
        code = self.species_code
        return "" if code is None or code == UNSURE else code


@cache
def _bundled_species(text: str) -> Species | None:
    return find_species(text, load_species())


def middle_ns(estimate: LengthEstimate) -> int:
    """Halfway between the capture times of a fish's first and last frame."""
    return (estimate.first_timestamp_ns + estimate.last_timestamp_ns) // 2


def database_of(path: Path) -> Path | None:
    """The lengths.db of a folder; None without one."""
    database = path / NAME
    return database if path.is_dir() and database.is_file() else None


def read_fish(path: Path, recording: Recording, selection: Selection = EVERYTHING) -> list[Fish]:
    """The fish of a folder from its lengths.db, or from the recording if it has none.

    Raises OutputError or RecordingError if they can't be read.
    """
    database = database_of(path)
    if database is not None:
        fish = read_stored_fish(database)
        return [
            known
            for known in fish
            if selection.includes(known.estimate)
            and selection.includes_time(known.estimate.last_timestamp_ns)
        ]
    facts_of, track = cache(run_facts), recorded_track(recording)
    return [
        Fish(
            estimate=estimate,
            facts=facts_of(header_at(recording, estimate.last_timestamp_ns)),
            run_id="",
            where=track.at(middle_ns(estimate)),
        )
        for estimate in messages_of(recording, LengthEstimate, selection)
        if estimate.is_final
    ]


def recorded_track(recording: Recording) -> VesselTrack:
    """The vessel's track of a recording, as its run's settings cut it at gaps."""
    settings = recorded_settings(recording.header, "sensors", SensorsSettings)
    positions = messages_of(recording, Position)
    return VesselTrack(kept_of(positions, keep_s=settings.keep_s, max_gap_s=settings.max_gap_s))


def read_stored_fish(database: Path) -> list[Fish]:
    """All fish of a lengths.db as reviewed: with added, split and merged fish.

    A fish that was merged into another stays, with that decision. Raises OutputError if the file
    is damaged.
    """
    return _stored_fish(database, read_verdicts(database))


def read_measured_fish(database: Path, *, span: Haul | None = None) -> list[Fish]:
    """All fish of a lengths.db as they were measured, without any review. OutputError likewise.

    `span`: only those whose track ended in it.
    """
    return _stored_fish(database, (), span=span)


def _stored_fish(
    database: Path, verdicts: Sequence[Verdict], *, span: Haul | None = None
) -> list[Fish]:
    reviews, edits = reviews_of(verdicts), edits_of(verdicts).fish
    try:
        with reading(database) as connection:
            runs = {row["run_id"]: _run_of(row) for row in rows(connection, RUNS)}
            stored = [
                row
                for row in rows(connection, FISH)
                if span is None or span.includes(row["last_timestamp_ns"])
            ]
            hauls = hauls_of(rows(connection, HAULS))
            vessel = VesselTrack(positions_of(connection))
        if unknown := {row["run_id"] for row in stored} - runs.keys():
            raise OutputError(
                f"{database}: expected the runs of its fish in its table runs, found none of "
                f"{', '.join(sorted(unknown))}; the file is damaged: use a copy of it, or `replay` "
                "the recording"
            )

        def fish(row: Mapping[str, Any], estimate: LengthEstimate, run_id: str, **of: str) -> Fish:
            moment_ns = middle_ns(estimate)
            return Fish(
                estimate=estimate,
                facts=runs[run_id],
                run_id=run_id,
                iou=row["iou"],
                flags=json.loads(row["flags"]),
                haul=haul_at(hauls, moment_ns) if hauls else runs[run_id].haul,
                where=vessel.at(moment_ns),
                review=reviews.get(estimate.track_id, NOT_REVIEWED),
                **of,
            )

        tracks = {row["track_id"]: fish(row, estimate_of(row), row["run_id"]) for row in stored}
        made = dict[int, Fish]()
        for track_id, edited in edits.items():
            known = [
                (part, tracks[part.track_id])
                for part in edited.parts
                if part.track_id in tracks and part.overlaps(tracks[part.track_id].estimate)
            ]
            known.sort(key=lambda pair: max(pair[0].first_frame, pair[1].estimate.first_frame))
            estimate = _with_catch(estimate_of(edited.row), known)
            began_ns = estimate.first_timestamp_ns
            beside = min(  # of its first frames; an added fish is of the run of the nearest one
                [fish for _, fish in known[:1]] or tracks.values(),
                key=lambda fish: abs(fish.estimate.first_timestamp_ns - began_ns),
                default=None,
            )
            run_id = [*runs][-1] if beside is None else beside.run_id
            made[track_id] = fish(edited.row, estimate, run_id, origin=edited.kind)
    except (ValueError, KeyError) as error:
        raise OutputError(
            f"{database}: expected the fish of its runs, got: {error!r}; the file is damaged"
        ) from error
    return list((tracks | made).values())


def _with_catch(
    estimate: LengthEstimate, known: Sequence[tuple[TrackPart, Fish]]
) -> LengthEstimate:
    """With the species of the first track, and the fate of the last track if it ended there."""
    if not known:
        return estimate
    first = known[0][1].estimate
    part, fish = max(known, key=lambda pair: min(pair[0].last_frame, pair[1].estimate.last_frame))
    last = fish.estimate
    is_whole = part.last_frame >= last.last_frame
    return replace(
        estimate,
        species_code=first.species_code,
        species_share=first.species_share,
        fate=last.fate if is_whole else None,
        fate_share=last.fate_share if is_whole else None,
    )


def read_runs(database: Path) -> dict[str, RunFacts]:
    """The facts of the runs by run id, in their order. Raises OutputError."""
    return {row["run_id"]: _run_of(row) for row in read_rows(database, RUNS)}


def run_notes(path: Path) -> list[str]:
    """A line for each run that measured a part of its source, wrong clock and wrong scale.

    Raises OutputError.
    """
    database = database_of(path)
    if database is None:
        return []
    runs, checks = read_runs(database), last_checks(database)
    used = {facts.calibration_sha256 for facts in runs.values()}
    alarms = [c.alarm for sha256, c in checks.items() if c.alarm and sha256 in used]
    parts = [line for facts in runs.values() if (line := cut_short(facts))]
    return [*parts, *_clock_notes(database, runs), *alarms]


def _clock_notes(database: Path, runs: Mapping[str, RunFacts]) -> Iterator[str]:
    for run_id, (began_ns, ended_ns) in run_times(database).items():
        if began_ns is not None and ended_ns is not None and ended_ns < began_ns:
            early_s = (began_ns - ended_ns) / 1e9
            yield (
                f"the run of {runs[run_id].source} ended {early_s:.0f} s before it began: its "
                "machine's clock was set back meanwhile"
            )


def last_run_like(database: Path, expected: RunFacts) -> RunFacts | None:
    """The last run with this command, config, calibration and template. Raises OutputError."""
    names = ("command", "config_sha256", "calibration_sha256", "template_sha256")
    made = [
        run
        for run in read_runs(database).values()
        if all(getattr(run, name) == getattr(expected, name) for name in names)
    ]
    return made[-1] if made else None


def assigns_ids(folder: Path) -> bool:
    """True if a run in a folder was given no ids of its fish. Raises OutputError."""
    database = database_of(folder)
    runs = {} if database is None else read_runs(database)
    texts = [{k: v for k, v in asdict(f).items() if isinstance(v, str)} for f in runs.values()]
    given = [RunInputs.from_metadata(t) or RunInputs.from_command(t["command"]) for t in texts]
    return any(inputs is not None and not (inputs.boxes or inputs.masks) for inputs in given)


def run_times(database: Path) -> dict[str, list[int | None]]:
    """When each run began and ended, ns of the wall clock."""
    runs = read_rows(database, RUNS)
    return {run["run_id"]: [run["started_ns"], run["ended_ns"]] for run in runs}


def rows_by_run(database: Path, table: Table) -> dict[str, list[str]]:
    """Every stored value of the rows of each run, as lines of JSON, for checksums.

    LATER_COLUMNS are there by name if they have a value, since older databases lack them.
    """
    lines: dict[str, list[str]] = {}
    for row in read_rows(database, table):
        added = {name: row.pop(name, None) for name in LATER_COLUMNS}
        facts = {name: value for name, value in added.items() if value is not None}
        line = [*row.values(), *([facts] if facts else [])]
        lines.setdefault(row["run_id"], []).append(json.dumps(line, default=repr))
    return lines


def flagged_fish(out_dir: Path) -> set[int]:
    """The ids of fish whose length has a flag. Raises OutputError if they can't be read."""
    path = out_dir / NAME
    if not path.exists():
        return set()
    with reading(path) as database:
        return {i for (i,) in database.execute("SELECT track_id FROM fish WHERE flags != '[]'")}


def _run_of(row: Mapping[str, Any]) -> RunFacts:
    return RunFacts(**{f.name: row[f.name] for f in fields(RunFacts) if row[f.name] is not None})


def is_same_species(name: str, other: str) -> bool:
    """True if two texts name the same species, by its code, a name, or its template."""
    return species_named(name) == species_named(other)


@cache
def species_named(text: str) -> str:
    """The code of the species that a text names, else the text, whatever its capitals."""
    form = load_body_forms().get(text.strip().casefold())
    scientific_name = None if form is None else form.title.split(", ")[-1]
    found = find_species(scientific_name or text, load_species())
    return found.code if found else text.strip().casefold()
