"""Verdicts of reviewers on fish: a log, to which rows are only added (`verdicts_table`).

Measurements stay as they were. The review of a fish is the sum of its verdicts: the last decision,
species, fate, condition and correction; `withdraw` takes back all before it, `undo` a single
verdict. `add`, `split` and `merge` change the frames of a fish (`edits`). A blind reading changes
no review: it is only compared with it.
"""

import json
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path

from stream_dmr.errors import OutputError, UserError
from stream_dmr.lengths.fate import CONDITIONS, FATES
from stream_dmr.store.schema import (
    ADDED_FRAMES,
    MARK,
    REVIEWED_ID,
    VERDICTS,
    DiskRefusal,
    insertion,
    open_for_writing,
    reading,
    records,
    refusing,
    transaction,
)

DECISIONS = ("accept", "reject", "duplicate", "merge")
NOT_COUNTED = frozenset(DECISIONS[1:])  # decisions after which a fish stands in no sum
EDITS = ("add", "split", "merge")
KINDS = (
    *(*DECISIONS[:3], "species", "fate", "condition", "correct", "withdraw"),
    *(*EDITS, "undo"),
)
BLIND = "blind"  # the reading of somebody who does not see the decisions of others
Ends = tuple[tuple[float, float], tuple[float, float]]  # head and tail, frame pixels


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
    undoes: int | None = None  # number of the verdict that this takes back, from 1
    other_fish: int | None = None  # of a split: the new fish; of a merge: the remaining fish
    fish: str | None = None  # of an edit: the final rows of the fish that it makes, as JSON
    frames_sha256: str | None = None  # of an added fish: of its rows in `added_frames`
    reading: str | None = None  # BLIND, or None
    fate: str | None = None  # of FATES
    condition: str | None = None  # of CONDITIONS

    @property
    def in_words(self) -> str:
        return {
            "accept": "accepted",
            "reject": f"rejected, {self.reason}",
            "duplicate": f"duplicate of fish {self.duplicate_of}",
            "species": f"species {self.species}",
            "fate": f"fate {self.fate}",
            "condition": f"condition {self.condition}",
            "correct": f"points moved in frame {self.frame_index}",
            "withdraw": "verdicts withdrawn",
            "add": "added",
            "split": f"from frame {self.frame_index} on it is fish {self.other_fish}",
            "merge": f"goes on as fish {self.other_fish}",
        }[self.kind]

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
    """The state of a fish's review; "" and None if no verdict sets a value."""

    decision: str = ""  # of DECISIONS
    reason: str = ""
    duplicate_of: int | None = None
    species: str = ""
    fate: str | None = None
    condition: str | None = None
    length_mm: float | None = None  # corrected
    length_std_mm: float | None = None
    moved: Mapping[int, Ends] = field(default_factory=dict[int, Ends])  # corrections, by frame
    reviewer: str = ""  # the last reviewer
    written_ns: int = 0

    def after(self, verdict: Verdict) -> "Review":
        before = Review() if verdict.kind == "withdraw" else self
        now = replace(before, reviewer=verdict.reviewer, written_ns=verdict.written_ns)
        match verdict.kind:
            case "withdraw" | "add" | "split":
                return now
            case "species" | "fate" | "condition":
                return replace(now, **{verdict.kind: getattr(verdict, verdict.kind)})
            case "correct":
                return replace(
                    now,
                    length_mm=verdict.length_mm,
                    length_std_mm=verdict.length_std_mm,
                    moved={**now.moved, **verdict.moved},
                )
            case "merge":
                return replace(now, decision="merge", duplicate_of=verdict.other_fish)
            case _:
                return replace(
                    now,
                    decision=verdict.kind,
                    reason=verdict.reason,
                    duplicate_of=verdict.duplicate_of,
                )


NOT_REVIEWED = Review()


def standing(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """The verdicts that count: not taken back by an `undo`, and of no blind reading."""
    return [verdict for _, verdict in _not_undone(verdicts) if verdict.reading is None]


def blind_readings(verdicts: Sequence[Verdict]) -> dict[str, list[Verdict]]:
    """The readings of each blind reader, by name, as verdicts that `reviews_of` counts."""
    readings: dict[str, list[Verdict]] = {}
    for _, verdict in _not_undone(verdicts):
        if verdict.reading == BLIND:
            readings.setdefault(verdict.reviewer, []).append(replace(verdict, reading=None))
    return readings


def last_of(verdicts: Sequence[Verdict], reviewer: str, reading: str | None) -> int | None:
    """Number of the last verdict of a reviewer that was not taken back; None without any."""
    mine = (reviewer, reading)
    numbers = (n for n, v in _not_undone(verdicts) if (v.reviewer, v.reading) == mine)
    return max(numbers, default=None)


def _not_undone(verdicts: Sequence[Verdict]) -> list[tuple[int, Verdict]]:
    """The verdicts with their numbers, without `undo` and the verdicts that it takes back."""
    undone = {verdict.undoes for verdict in verdicts}
    numbered = enumerate(verdicts, start=1)
    return [(n, v) for n, v in numbered if v.kind != "undo" and n not in undone]


def check_verdict(verdict: Verdict, track_ids: set[int], reviews: Mapping[int, Review]) -> None:
    """Raise UserError if a verdict contradicts itself or the reviews so far.

    `track_ids`: the fish of the run as reviewed, without fish merged into others. Of fish that are
    duplicates of each other, one must remain.
    """
    known = verdict.track_id in track_ids
    problems = {
        f"a fish of this run, got {verdict.track_id}": not known,
        f"one of {', '.join(KINDS)}, got {verdict.kind!r}": verdict.kind not in KINDS,
        "the reviewer's name": not verdict.reviewer.strip(),
        "a reason for the rejection": verdict.kind == "reject" and not verdict.reason.strip(),
        "the name of a species": verdict.kind == "species" and not verdict.species.strip(),
        f"a fate of {', '.join(FATES)}, got {verdict.fate!r}": verdict.kind == "fate"
        and verdict.fate not in FATES,
        f"a condition of {', '.join(CONDITIONS)}, got {verdict.condition!r}": (
            verdict.kind == "condition" and verdict.condition not in CONDITIONS
        ),
        f"the number of another fish, got {verdict.duplicate_of}": verdict.kind == "duplicate"
        and (verdict.duplicate_of not in track_ids or verdict.duplicate_of == verdict.track_id),
        f"fish {verdict.other_fish} to count, as what is merged into it goes with it; withdraw its "
        "verdicts first": verdict.kind == "merge"
        and reviews.get(verdict.other_fish or 0, NOT_REVIEWED).decision in NOT_COUNTED,
        f"a fish that is not itself a duplicate of fish {verdict.track_id}; withdraw that first": (
            verdict.kind == "duplicate" and verdict.track_id in _originals(verdict, reviews)
        ),
    }
    for expected, is_wrong in problems.items():
        if is_wrong:
            raise UserError(f"verdict: expected {expected}")


def _originals(verdict: Verdict, reviews: Mapping[int, Review]) -> list[int]:
    """The fish that this fish duplicates, directly and by earlier verdicts, until one repeats."""
    originals, track_id = list[int](), verdict.duplicate_of
    while track_id is not None and track_id not in originals:
        originals.append(track_id)
        track_id = reviews.get(track_id, NOT_REVIEWED).duplicate_of
    return originals


def reviews_of(verdicts: Sequence[Verdict]) -> dict[int, Review]:
    """The review of each fish that has a verdict which counts, by track id.

    A verdict that closes a circle of duplicates doesn't count: one of the fish must remain.
    """
    reviews: dict[int, Review] = {}
    for verdict in standing(verdicts):
        if verdict.kind == "duplicate" and verdict.track_id in _originals(verdict, reviews):
            continue
        before = reviews.get(verdict.track_id, NOT_REVIEWED)
        reviews[verdict.track_id] = before.after(verdict)
        other = verdict.other_fish
        if verdict.kind == "merge" and other is not None and before.species:
            remaining = reviews.get(other, NOT_REVIEWED)
            if not remaining.species:  # one fish has one species; its fate is that of its end
                named = replace(verdict, kind="species", species=before.species)
                reviews[other] = remaining.after(named)
    return reviews


def reviews_after(verdicts: Sequence[Verdict], numbers: Iterable[int]) -> Iterator[Review]:
    """The review of a verdict's fish right after it, for each of these numbers, from 1.

    After a blind reader's verdict it is that reader's.
    """
    of_fish = defaultdict[int, list[tuple[int, Verdict]]](list)
    undone_by = dict[int, int]()  # by number of a verdict, that of the first which takes it back
    for number, verdict in enumerate(verdicts, start=1):
        of_fish[verdict.track_id].append((number, verdict))
        if verdict.undoes is not None:
            undone_by.setdefault(verdict.undoes, number)
    for number in numbers:
        last = verdicts[number - 1]
        said = [
            replace(verdict, reading=None)
            for n, verdict in of_fish[last.track_id]
            if n <= number < undone_by.get(n, number + 1)
            and verdict.kind != "undo"
            and verdict.reading == last.reading
            and (last.reading is None or verdict.reviewer == last.reviewer)
        ]
        yield reviews_of(said).get(last.track_id, NOT_REVIEWED)


# Fields of a verdict that stand in no checksum if they are None: older databases lack them.
_LATER = {"undoes", "other_fish", "fish", "frames_sha256", "reading", "fate", "condition"}


@dataclass(frozen=True, kw_only=True)
class AddedFrame:
    """One frame of a fish that a reviewer added; its messages encoded as in a recording."""

    track_id: int
    frame_index: int
    crop: bytes
    fit: bytes
    fish: bytes


def frames_sha256(frames: Sequence[AddedFrame]) -> str:
    """SHA-256 of added frames, for the verdict that adds them."""
    return sha256(repr([tuple(asdict(frame).values()) for frame in frames]).encode()).hexdigest()


def add_verdict(
    path: Path, *verdicts: Verdict, frames: Sequence[AddedFrame] = (), known: int | None = None
) -> Verdict:
    """Write verdicts into a lengths.db, durably, all or none; returns the last with its time.

    `frames` are those of added fish. With `known`, the number of verdicts that they build on,
    UserError where another reviewer has written meanwhile. Raises OutputError if the disk refuses
    it.
    """
    written = [replace(verdict, written_ns=time.time_ns()) for verdict in verdicts]
    try:
        database = open_for_writing(path)
    except DiskRefusal as error:
        raise OutputError(
            f"{path}: expected a disk to write verdicts to, got: {error.__cause__}; review a copy "
            "of the folder"
        ) from error
    with refusing(path), closing(database), transaction(database):
        (count,) = database.execute("SELECT COUNT(*) FROM verdicts").fetchone()
        if known is not None and count != known:
            raise UserError(
                "verdict: expected the fish as this page shows them, but another reviewer has "
                "changed them meanwhile; look again, and repeat it"
            )
        for verdict in written:
            database.execute(*insertion(VERDICTS, asdict(verdict)))
            new_fish = {"add": verdict.track_id, "split": verdict.other_fish}.get(verdict.kind)
            if new_fish is not None:
                database.execute(MARK, (REVIEWED_ID, new_fish))  # no later run may use it
        for frame in frames:
            database.execute(*insertion(ADDED_FRAMES, asdict(frame)))
    return written[-1]


def read_verdicts(path: Path, *, after: int | None = None) -> list[Verdict]:
    """All verdicts of a lengths.db in the order of writing. Raises OutputError.

    `after`: only those whose number is higher.
    """
    with reading(path) as database:
        return records(database, VERDICTS, Verdict, after=after)


def read_added_frames(path: Path) -> dict[int, list[AddedFrame]]:
    """The frames of the fish that reviewers added, by track id. Raises OutputError."""
    frames: dict[int, list[AddedFrame]] = {}
    with reading(path) as database:
        for frame in records(database, ADDED_FRAMES, AddedFrame):
            frames.setdefault(frame.track_id, []).append(frame)
    return frames


def next_track_id(path: Path) -> int:
    """A track id that neither a run nor a reviewer has used in this folder. Raises OutputError."""
    with reading(path) as database:
        query = (
            "SELECT MAX(n) FROM (SELECT MAX(track_id) AS n FROM fish UNION "
            f"SELECT value FROM marks WHERE name IN ('track_id', '{REVIEWED_ID}'))"
        )
        return 1 + (database.execute(query).fetchone()[0] or 0)


def verdict_line(verdict: Verdict) -> str:
    """A verdict as JSON, for checksums."""
    values = vars(verdict).items()
    return json.dumps({n: v for n, v in values if v is not None or n not in _LATER})
