"""Watched time and measured share by haul, to divide counts of fish by."""

from collections import Counter
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
    if hauls:
        efforts = list[HaulEffort]()
        for name in dict.fromkeys(haul.name for haul in hauls):
            named = [haul for haul in hauls if haul.name == name]  # it may begin again after others
            effort = _effort(name, watched, [_overlap(row, named) for row in watched], fish)
            began_ns, ended_ns = named[0].began_ns, named[-1].ended_ns
            efforts.append(replace(effort, began_ns=began_ns, ended_ns=ended_ns))
        shares = [1.0 - _overlap(row, hauls) for row in watched]
        outside = _effort("", watched, shares, fish)
        if outside.num_fish or outside.hours_watched > 1e-3:
            efforts.append(outside)
        return efforts
    by_run = {run_id: facts.haul for run_id, facts in read_runs(database).items()}
    efforts = list[HaulEffort]()
    for name in dict.fromkeys(by_run.values()):
        shares = [float(by_run.get(row["run_id"]) == name) for row in watched]
        effort = _effort(name, watched, shares, fish)
        of_haul = [row for row in rows if name and by_run.get(row["run_id"]) == name]
        began_ns = min((row["first_ns"] for row in of_haul), default=None)
        ended_ns = max((row["last_ns"] for row in of_haul), default=None)
        efforts.append(replace(effort, began_ns=began_ns, ended_ns=ended_ns))
    return efforts


def watched_times(database: Path) -> list[int]:
    """Capture times of the first and last frames between pauses. Raises OutputError."""
    return [row[end] for row in read_rows(database, WATCHED) for end in ("first_ns", "last_ns")]


def _effort(
    name: str, watched: Sequence[Mapping[str, Any]], shares: Sequence[float], fish: Sequence[Fish]
) -> HaulEffort:
    """`shares` (for each row of `watched`, 0 to 1): the part of each watched time in the haul."""
    parts = list(zip(watched, shares, strict=True))
    frames = sum(row["frames"] * share for row, share in parts)
    lost = sum(row["frames_lost"] * share for row, share in parts)
    of_haul = [caught for caught in fish if caught.haul == name]
    has_fates = any(caught.fate is not None for caught in fish)
    return HaulEffort(
        haul=name,
        hours_watched=sum((_hours(row) * share for row, share in parts), start=0.0),
        share_measured=frames / (frames + lost) if frames + lost else None,
        num_fish=len(of_haul),
        num_measured=sum(caught.length_mm is not None for caught in of_haul),
        fates=Counter(caught.fate for caught in of_haul if caught.fate) if has_fates else None,
    )


def _hours(row: Mapping[str, Any]) -> float:
    return (row["last_ns"] - row["first_ns"]) / _HOUR_NS


def _overlap(row: Mapping[str, Any], hauls: Sequence[Haul]) -> float:
    """The share of a watched time that lies in hauls."""
    span_ns = row["last_ns"] - row["first_ns"]
    if span_ns <= 0:
        return float(any(haul.includes(row["first_ns"]) for haul in hauls))
    covered = 0
    for haul in hauls:
        end_ns = row["last_ns"] if haul.ended_ns is None else min(row["last_ns"], haul.ended_ns)
        covered += max(0, end_ns - max(row["first_ns"], haul.began_ns))
    return covered / span_ns
