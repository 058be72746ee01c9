"""What reviewers said of fish: a table of its own in lengths.db, to which rows are only added.

The measurement stays as it was. What holds of a fish is what its rows say together: the last
decision, the last species, and the last correction; `withdraw` takes back all before it.
"""

import os
import sqlite3
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from stream_dmr.errors import OutputError, UserError
from stream_dmr.results.store_schema import open_database

KINDS = ("accept", "reject", "duplicate", "species", "correct", "withdraw")
DECISIONS = KINDS[:3]
Ends = tuple[tuple[float, float], tuple[float, float]]  # head and tail, frame pixels
_TABLE = """
CREATE TABLE IF NOT EXISTS verdicts (
    number INTEGER PRIMARY KEY,
    track_id INTEGER NOT NULL,
    kind TEXT NOT NULL,
    reason TEXT NOT NULL, -- of a rejection
    species TEXT NOT NULL,
    duplicate_of INTEGER, -- track id
    frame_index INTEGER, -- of a correction: where its points, in frame pixels, were set
    head_u REAL, head_v REAL, tail_u REAL, tail_v REAL,
    length_mm REAL, length_std_mm REAL, -- of all frames that are corrected so far
    reviewer TEXT NOT NULL,
    written_ns INTEGER NOT NULL -- wall clock
) STRICT
"""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One row: what one reviewer said of one fish."""

    track_id: int
    kind: str  # of KINDS
    reviewer: str
    reason: str = ""
    species: str = ""
    duplicate_of: int | None = None
    frame_index: int | None = None
    head_u: float | None = None
    head_v: float | None = None
    tail_u: float | None = None
    tail_v: float | None = None
    length_mm: float | None = None
    length_std_mm: float | None = None
    written_ns: int = 0

    @property
    def moved(self) -> dict[int, Ends]:
        """The points of a correction, by their frame."""
        head_u, head_v, tail_u, tail_v = self.head_u, self.head_v, self.tail_u, self.tail_v
        if self.frame_index is None or head_u is None or head_v is None:
            return {}
        if tail_u is None or tail_v is None:
            return {}
        return {self.frame_index: ((head_u, head_v), (tail_u, tail_v))}


@dataclass(frozen=True, kw_only=True)
class Review:
    """What holds of one fish; "" and None where nothing was said."""

    decision: str = ""  # of DECISIONS
    reason: str = ""
    duplicate_of: int | None = None
    species: str = ""
    length_mm: float | None = None  # as corrected
    length_std_mm: float | None = None
    moved: Mapping[int, Ends] = field(default_factory=dict)  # by frame: where it was corrected
    reviewer: str = ""  # the last one
    written_ns: int = 0

    def after(self, verdict: Verdict) -> "Review":
        """What holds after one more verdict."""
        signed = {"reviewer": verdict.reviewer, "written_ns": verdict.written_ns}
        match verdict.kind:
            case "withdraw":
                return Review(**signed)
            case "species":
                return replace(self, species=verdict.species, **signed)
            case "correct":
                lengths = {"length_mm": verdict.length_mm, "length_std_mm": verdict.length_std_mm}
                moved = {**self.moved, **verdict.moved}
                return replace(self, **lengths, moved=moved, **signed)
            case _:
                said = {"reason": verdict.reason, "duplicate_of": verdict.duplicate_of}
                return replace(self, decision=verdict.kind, **said, **signed)


NOTHING_SAID = Review()


def check(verdict: Verdict, track_ids: set[int]) -> None:
    """Raise UserError where a verdict says nothing that could hold."""
    known = verdict.track_id in track_ids
    problems = {
        f"a fish of this run, got {verdict.track_id}": not known,
        f"one of {', '.join(KINDS)}, got {verdict.kind!r}": verdict.kind not in KINDS,
        "the reviewer's name": not verdict.reviewer.strip(),
        "a reason for the rejection": verdict.kind == "reject" and not verdict.reason.strip(),
        "the name of a species": verdict.kind == "species" and not verdict.species.strip(),
        "another fish that this one repeats": verdict.kind == "duplicate"
        and (verdict.duplicate_of not in track_ids or verdict.duplicate_of == verdict.track_id),
    }
    for expected, is_wrong in problems.items():
        if is_wrong:
            raise UserError(f"verdict: expected {expected}")


def add_verdict(path: Path, verdict: Verdict) -> Verdict:
    """Write one row into a lengths.db, durably; returns it with its time. OutputError."""
    verdict = replace(verdict, written_ns=time.time_ns())
    names = [field.name for field in fields(Verdict)]
    values = [getattr(verdict, name) for name in names]
    marks = ", ".join("?" for _ in names)
    with _database(path, read_only=False) as database:
        database.execute(_TABLE)
        database.execute(f"INSERT INTO verdicts ({', '.join(names)}) VALUES ({marks})", values)
    return verdict


def read_verdicts(path: Path) -> list[Verdict]:
    """All rows of a lengths.db, in the order in which they were written."""
    with _database(path, read_only=not os.access(path.parent, os.W_OK)) as database:
        if not database.execute(
            "SELECT 1 FROM sqlite_master WHERE name = 'verdicts' AND type = 'table'"
        ).fetchone():
            return []
        names = [field.name for field in fields(Verdict)]
        rows = database.execute(f"SELECT {', '.join(names)} FROM verdicts ORDER BY number")
        return [Verdict(**dict(zip(names, row, strict=True))) for row in rows]


def reviews(verdicts: list[Verdict]) -> dict[int, Review]:
    """What holds of each fish of which anything was said."""
    held: dict[int, Review] = {}
    for verdict in verdicts:
        held[verdict.track_id] = held.get(verdict.track_id, NOTHING_SAID).after(verdict)
    return held


@contextmanager
def _database(path: Path, *, read_only: bool) -> Iterator[sqlite3.Connection]:
    try:
        with closing(open_database(path, read_only=read_only)) as database:
            yield database
    except sqlite3.Error as error:
        raise OutputError(f"{path}: expected a database of lengths, got: {error}") from error
