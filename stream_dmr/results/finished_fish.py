"""The finished fish of a run's folder or of a recording, with what made and what judged them."""

import json
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate
from stream_dmr.recording.messages.run_inputs import RunInputs
from stream_dmr.recording.messages.selection import EVERYTHING, Selection
from stream_dmr.recording.reading.open_recording import Recording, decoded_messages
from stream_dmr.results.run_facts import run_facts
from stream_dmr.results.store import NAME, RunFacts
from stream_dmr.results.store_rows import read_estimates
from stream_dmr.results.store_schema import open_database
from stream_dmr.results.verdicts import NOTHING_SAID, Review, read_verdicts, reviews


@dataclass(frozen=True, eq=False, kw_only=True)
class FishResult:
    """One finished fish."""

    estimate: LengthEstimate
    facts: RunFacts
    run_id: str  # "": of a recording without its database
    iou: float | None = None
    flags: Sequence[str] = ()
    review: Review = NOTHING_SAID

    @property
    def length_mm(self) -> float | None:
        """As a reviewer corrected it, else as it was measured."""
        corrected = self.review.length_mm
        return self.estimate.length_mm if corrected is None else corrected


def database_of(path: Path) -> Path | None:
    """The lengths.db that belongs to a folder, if there is one."""
    database = path / NAME
    return database if path.is_dir() and database.is_file() else None


def read_fish(
    path: Path, recording: Recording, selection: Selection = EVERYTHING
) -> list[FishResult]:
    """The fish of a folder by its lengths.db, or by the recording where it has none.

    Raises OutputError or RecordingError where they can't be read.
    """
    database = database_of(path)
    if database is not None:
        fish = read_stored(database)
        return [
            one
            for one in fish
            if selection.includes(one.estimate)
            and selection.includes_time(one.estimate.last_timestamp_ns)
        ]
    facts = run_facts(recording.header)
    found = (message for message, _ in decoded_messages(recording, [LengthEstimate], selection))
    return [
        FishResult(estimate=estimate, facts=facts, run_id="")
        for estimate in found
        if isinstance(estimate, LengthEstimate) and estimate.is_final
    ]


def read_stored(database: Path) -> list[FishResult]:
    """All fish of a lengths.db. OutputError where it is damaged."""
    return _stored_fish(database, reviews(read_verdicts(database)))


def read_runs(database: Path) -> dict[str, RunFacts]:
    """What made the lengths, by run id, in the order of the runs. OutputError."""
    with _opened(database) as connection:
        return dict(_runs(connection))


def numbers_its_own(folder: Path) -> bool:
    """True where a run in a folder was given no files that say which fish is which. OutputError."""
    database = database_of(folder)
    runs = {} if database is None else read_runs(database)
    given = [RunInputs.from_facts(asdict(facts)) for facts in runs.values()]
    return any(inputs is not None and not (inputs.boxes or inputs.masks) for inputs in given)


def fish_by_run(database: Path) -> dict[str, list[str]]:
    """Every stored value of the fish of each run, as JSON, a line each: for checksums."""
    lines: dict[str, list[str]] = {}
    with _opened(database) as connection:
        for row in connection.execute("SELECT run_id, * FROM fish ORDER BY number"):
            lines.setdefault(row[0], []).append(json.dumps(row[1:]))
    return lines


def _opened(database: Path) -> closing[sqlite3.Connection]:
    """For reading; who may only read can't tidy up SQLite's own files beside it, so others do."""
    return closing(open_database(database, read_only=not os.access(database.parent, os.W_OK)))


def _runs(connection: sqlite3.Connection) -> Iterator[tuple[str, RunFacts]]:
    rows = connection.execute("SELECT * FROM runs ORDER BY started_ns")
    columns = [column[0] for column in rows.description]
    for values in rows:
        row = dict(zip(columns, values, strict=True))  # an older database has fewer columns
        yield row["run_id"], RunFacts(**{f.name: row.get(f.name) or "" for f in fields(RunFacts)})


def _stored_fish(database: Path, held: dict[int, Review]) -> list[FishResult]:
    try:
        with _opened(database) as connection:
            runs = dict(_runs(connection))
            estimates = read_estimates(connection)
            others = connection.execute("SELECT run_id, iou, flags FROM fish ORDER BY number")
            return [
                FishResult(
                    estimate=estimate,
                    facts=runs[run_id],
                    run_id=run_id,
                    iou=iou,
                    flags=json.loads(flags),
                    review=held.get(estimate.track_id, NOTHING_SAID),
                )
                for estimate, (run_id, iou, flags) in zip(estimates, others, strict=True)
            ]
    except (sqlite3.Error, ValueError, KeyError) as error:
        raise OutputError(
            f"{database}: expected the fish of its runs, got: {error!r}; the file is damaged"
        ) from error
