"""Watched time and measured share by haul, to divide counts of fish by."""

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stream_dmr.store.fish import Fish, read_runs
from stream_dmr.store.schema import HAULS, WATCHED, read_rows
from stream_dmr.store.trip import Haul, hauls_of

_HOUR_NS = 3_600_000_000_000


@dataclass(frozen=True, kw_only=True)
class HaulEffort:
    """One haul, or the time outside of hauls with the name ""."""

    haul: str
    began_ns: int | None = None  # on the clock of the frames; None: unknown
    ended_ns: int | None = None
    hours_watched: float = 0.0  # with frames
    share_measured: float | None = None  # of the frames that came; None if unknown
    num_fish: int = 0
    num_measured: int = 0  # with a length
    fates: Mapping[str, int] | None = None  # number of fish; None: nobody looked for any's fate


def read_effort(
    database: Path, fish: Sequence[Fish], *, span: Haul | None = None
) -> list[HaulEffort]:
    """The effort of each haul of a folder, and of the time between them. Raises OutputError.

    `span`: only the watched time in this span, to the minute of a row.
    """
    hauls = hauls_of(read_rows(database, HAULS))
    rows = read_rows(database, WATCHED)
    watched = [row for row in rows if span is None or span.includes(row["last_ns"])]
    fish_of, parts = defaultdict[str, list[Fish]](list), defaultdict[str, list[_Part]](list)
    for caught in fish:
        fish_of[caught.haul].append(caught)
    has_fates = any(caught.fate is not None for caught in fish)
    efforts = list[HaulEffort]()
    if hauls:
        spans, outside = dict[str, tuple[int, int | None]](), list[_Part]()
        for haul in hauls:  # one may begin again after others
            began_ns, _ = spans.get(haul.name, (haul.began_ns, None))
            spans[haul.name] = began_ns, haul.ended_ns
        for row in watched:
            covered, whole_ns = _covered(row, hauls)
            for name, covered_ns in covered.items():
                parts[name].append((row, covered_ns / whole_ns))
            outside.append((row, 1.0 - covered.total() / whole_ns))
        for name, (began_ns, ended_ns) in spans.items():
            effort = _effort(name, parts[name], fish_of[name], has_fates=has_fates)
            efforts.append(replace(effort, began_ns=began_ns, ended_ns=ended_ns))
        between = _effort("", outside, fish_of[""], has_fates=has_fates)
        if between.num_fish or between.hours_watched > 1e-3:
            efforts.append(between)
        return efforts
    by_run = {run_id: facts.haul for run_id, facts in read_runs(database).items()}
    for row in watched:
        if (name := by_run.get(row["run_id"])) is not None:
            parts[name].append((row, 1.0))
    for name in dict.fromkeys(by_run.values()):
        effort = _effort(name, parts[name], fish_of[name], has_fates=has_fates)
        of_haul = [row for row in rows if name and by_run.get(row["run_id"]) == name]
        began_ns = min((row["first_ns"] for row in of_haul), default=None)
        ended_ns = max((row["last_ns"] for row in of_haul), default=None)
        efforts.append(replace(effort, began_ns=began_ns, ended_ns=ended_ns))
    return efforts


def watched_times(database: Path) -> list[int]:
    """Capture times of the first and last frames between pauses. Raises OutputError."""
    return [row[end] for row in read_rows(database, WATCHED) for end in ("first_ns", "last_ns")]


_Part = tuple[Mapping[str, Any], float]
"""A row of `watched`, and the share of its time that counts, 0 to 1."""


def _effort(
    name: str, parts: Sequence[_Part], fish: Sequence[Fish], *, has_fates: bool
) -> HaulEffort:
    """The effort of one haul, by its part of the watched time and its fish."""
    frames = sum(row["frames"] * share for row, share in parts)
    lost = sum(row["frames_lost"] * share for row, share in parts)
    return HaulEffort(
        haul=name,
        hours_watched=sum((_hours(row) * share for row, share in parts), start=0.0),
        share_measured=frames / (frames + lost) if frames + lost else None,
        num_fish=len(fish),
        num_measured=sum(caught.length_mm is not None for caught in fish),
        fates=Counter(caught.fate for caught in fish if caught.fate) if has_fates else None,
    )


def _hours(row: Mapping[str, Any]) -> float:
    return (row["last_ns"] - row["first_ns"]) / _HOUR_NS


def _covered(row: Mapping[str, Any], hauls: Sequence[Haul]) -> tuple[Counter[str], int]:
    """How much of a watched time lies in each haul, by name, and its whole length, ns."""
    first_ns = row["first_ns"]
    last_ns = max(row["last_ns"], first_ns + 1)  # one frame is a moment
    covered = Counter[str]()
    first, end = (
        bisect_right(hauls, t, key=lambda haul: haul.began_ns) for t in (first_ns, last_ns)
    )
    for haul in hauls[max(0, first - 1) : end]:
        end_ns = last_ns if haul.ended_ns is None else min(last_ns, haul.ended_ns)
        covered[haul.name] += max(0, end_ns - max(first_ns, haul.began_ns))
    return covered, last_ns - first_ns
