"""How much was watched and measured, by haul: what counts of fish are to be divided by."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stream_dmr.results.added_tables import read_added
from stream_dmr.results.finished_fish import FishResult, read_runs
from stream_dmr.results.hauls import HAULS, WATCHED, Haul, hauls_of

_HOUR_NS = 3_600_000_000_000


@dataclass(frozen=True, kw_only=True)
class HaulEffort:
    """One haul, or the time outside of hauls with the name ""."""

    haul: str
    began_ns: int | None = None  # on the clock of the frames; None: of no event
    ended_ns: int | None = None
    hours_watched: float = 0.0  # of which there are frames
    share_measured: float | None = None  # of the frames that came; None: not known
    num_fish: int = 0
    num_measured: int = 0  # with a length
    fates: Mapping[str, int] | None = None  # number of fish; None: nobody looked for any's fate


def read_effort(database: Path, fish: Sequence[FishResult]) -> list[HaulEffort]:
    """The effort of each haul of a folder, and of what is outside of them. Raises OutputError."""
    hauls = hauls_of(read_added(database, HAULS))
    watched = read_added(database, WATCHED)
    if hauls:
        efforts = [_effort(haul.name, [haul], watched, fish) for haul in _joined(hauls)]
        inside = sum(one.hours_watched for one in efforts)
        hours = max(0.0, sum(_hours(row) for row in watched) - inside)
        outside = replace(_effort("", [], watched, fish), hours_watched=hours)
        return [*efforts, *([outside] if outside.num_fish or hours > 1e-3 else [])]
    by_run = {run_id: facts.haul for run_id, facts in read_runs(database).items()}
    return [
        _effort(name, None, [row for row in watched if by_run.get(row["run_id"]) == name], fish)
        for name in dict.fromkeys(by_run.values())
    ]


def _joined(hauls: Sequence[Haul]) -> list[Haul]:
    """Each name once: with the first start and the last end."""
    by_name: dict[str, Haul] = {}
    for haul in hauls:
        first = by_name.get(haul.name, haul)
        by_name[haul.name] = Haul(name=haul.name, began_ns=first.began_ns, ended_ns=haul.ended_ns)
    return list(by_name.values())


def _effort(
    name: str,
    hauls: Sequence[Haul] | None,
    watched: Sequence[Mapping[str, Any]],
    fish: Sequence[FishResult],
) -> HaulEffort:
    """`hauls` None: all that was watched counts."""
    shares = [(row, 1.0 if hauls is None else _overlap(row, hauls)) for row in watched]
    frames = sum(row["frames"] * share for row, share in shares)
    lost = sum(row["frames_lost"] * share for row, share in shares)
    of_haul = [one for one in fish if one.haul == name]
    has_fates = any(one.fate is not None for one in fish)
    return HaulEffort(
        haul=name,
        began_ns=hauls[0].began_ns if hauls else None,
        ended_ns=hauls[0].ended_ns if hauls else None,
        hours_watched=sum((_hours(row) * share for row, share in shares), start=0.0),
        share_measured=frames / (frames + lost) if frames + lost else None,
        num_fish=len(of_haul),
        num_measured=sum(one.length_mm is not None for one in of_haul),
        fates=Counter(one.fate for one in of_haul if one.fate) if has_fates else None,
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
