"""Verdicts of reviewers on fish: a table of its own in lengths.db, to which rows are only added.

Measurements stay as they were. The review of a fish is what its verdicts say together: the last
decision, the last species and the last correction; `withdraw` takes back all before it.
"""

import sqlite3
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from stream_dmr.errors import OutputError, UserError
from stream_dmr.results.lengths_database import DiskRefusal, open_for_reading, open_for_writing

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
    """One row: the verdict of one reviewer on one fish."""

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
        """Head and tail of a correction by its frame; empty for other kinds."""
        head_u, head_v, tail_u, tail_v = self.head_u, self.head_v, self.tail_u, self.tail_v
        if self.frame_index is None or head_u is None or head_v is None:
            return {}
        if tail_u is None or tail_v is None:
            return {}
        return {self.frame_index: ((head_u, head_v), (tail_u, tail_v))}


@dataclass(frozen=True, kw_only=True)
class Review:
    """The state of one fish's review; "" and None where no verdict says anything."""

    decision: str = ""  # of DECISIONS
    reason: str = ""
    duplicate_of: int | None = None
    species: str = ""
    length_mm: float | None = None  # corrected
    length_std_mm: float | None = None
    moved: Mapping[int, Ends] = field(default_factory=dict[int, Ends])  # corrections, by frame
    reviewer: str = ""  # the last one
    written_ns: int = 0

    def after(self, verdict: Verdict) -> "Review":
        """The review after one more verdict."""
        before = Review() if verdict.kind == "withdraw" else self
        now = replace(before, reviewer=verdict.reviewer, written_ns=verdict.written_ns)
        match verdict.kind:
            case "withdraw":
                return now
            case "species":
                return replace(now, species=verdict.species)
            case "correct":
                return replace(
                    now,
                    length_mm=verdict.length_mm,
                    length_std_mm=verdict.length_std_mm,
                    moved={**now.moved, **verdict.moved},
                )
            case _:
                return replace(
                    now,
                    decision=verdict.kind,
                    reason=verdict.reason,
                    duplicate_of=verdict.duplicate_of,
                )


NOT_REVIEWED = Review()


def check_verdict(verdict: Verdict, track_ids: set[int], reviews: Mapping[int, Review]) -> None:
    """Raise UserError where a verdict contradicts itself or the reviews so far.

    `track_ids`: the fish of the run. Of fish that are duplicates of each other, one must remain.
    """
    known = verdict.track_id in track_ids
    problems = {
        f"a fish of this run, got {verdict.track_id}": not known,
        f"one of {', '.join(KINDS)}, got {verdict.kind!r}": verdict.kind not in KINDS,
        "the reviewer's name": not verdict.reviewer.strip(),
        "a reason for the rejection": verdict.kind == "reject" and not verdict.reason.strip(),
        "the name of a species": verdict.kind == "species" and not verdict.species.strip(),
        "another fish that this one repeats": verdict.kind == "duplicate"
        and (verdict.duplicate_of not in track_ids or verdict.duplicate_of == verdict.track_id),
        f"a fish that is not itself a duplicate of fish {verdict.track_id}; withdraw that first": (
            verdict.kind == "duplicate" and verdict.track_id in _originals(verdict, reviews)
        ),
    }
    for expected, is_wrong in problems.items():
        if is_wrong:
            raise UserError(f"verdict: expected {expected}")


def _originals(verdict: Verdict, reviews: Mapping[int, Review]) -> list[int]:
    """The fish that this one duplicates, directly and by earlier verdicts, until one repeats."""
    originals, track_id = list[int](), verdict.duplicate_of
    while track_id is not None and track_id not in originals:
        originals.append(track_id)
        track_id = reviews.get(track_id, NOT_REVIEWED).duplicate_of
    return originals


def add_verdict(path: Path, verdict: Verdict) -> Verdict:
    """Write a verdict into a lengths.db, durably; returns it with its time. Raises OutputError."""
    verdict = replace(verdict, written_ns=time.time_ns())
    names = [field.name for field in fields(Verdict)]
    values = [getattr(verdict, name) for name in names]
    marks = ", ".join("?" for _ in names)
    with _refusing(path), closing(_open_for_verdicts(path)) as database:
        database.execute(_TABLE)
        database.execute(f"INSERT INTO verdicts ({', '.join(names)}) VALUES ({marks})", values)
    return verdict


def read_verdicts(path: Path) -> list[Verdict]:
    """All verdicts of a lengths.db in the order of writing. Raises OutputError."""
    with _refusing(path), closing(open_for_reading(path)) as database:
        if not database.execute(
            "SELECT 1 FROM sqlite_master WHERE name = 'verdicts' AND type = 'table'"
        ).fetchone():
            return []
        names = [field.name for field in fields(Verdict)]
        rows = database.execute(f"SELECT {', '.join(names)} FROM verdicts ORDER BY number")
        return [Verdict(**dict(zip(names, row, strict=True))) for row in rows]


def reviews_of(verdicts: Sequence[Verdict]) -> dict[int, Review]:
    """The review of each fish that has a verdict, by track id.

    A verdict that closes a circle of duplicates doesn't count: one of the fish must remain.
    """
    reviews: dict[int, Review] = {}
    for verdict in verdicts:
        if verdict.kind == "duplicate" and verdict.track_id in _originals(verdict, reviews):
            continue
        reviews[verdict.track_id] = reviews.get(verdict.track_id, NOT_REVIEWED).after(verdict)
    return reviews


def _open_for_verdicts(path: Path) -> sqlite3.Connection:
    try:
        return open_for_writing(path)
    except DiskRefusal as error:
        raise OutputError(
            f"{path}: expected a disk to write verdicts to, got: {error.__cause__}; review a copy "
            "of the folder"
        ) from error


@contextmanager
def _refusing(path: Path) -> Generator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise OutputError(f"{path}: expected a database of lengths, got: {error}") from error
