"""What the methods measured, kept scene by scene: a run that was broken off goes on."""

import csv
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from stream_dmr.evaluation.length_tables import LengthRow
from stream_dmr.files import replacing
from stream_dmr.tables import write_table

CACHE = Path(__file__).parent / "cache"
_COLUMNS = ("row", "track_id", "truth_mm", "length_mm", "std_mm", "ci95_low_mm", "ci95_high_mm")


class Fish(NamedTuple):
    """One fish as one row of the table has it."""

    scene: int
    track_id: int
    truth_mm: float
    measured: LengthRow

    @property
    def key(self) -> int:
        """Unique among all scenes."""
        return 1000 * self.scene + self.track_id


def save(
    method: str,
    scene: int,
    truth_mm: dict[int, float],
    measured: dict[str, dict[int, LengthRow]],
    *,
    cache: Path,
) -> None:
    """Keep what a method measured of one scene; fish that it says nothing of have no length."""
    path = _path(cache, method, scene)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = list[list[object]]()
    for row, lengths in measured.items():
        for track_id, truth in truth_mm.items():
            length = lengths.get(track_id, LengthRow(length_mm=None))
            interval = length.ci95_mm or (None, None)
            values = (truth, length.length_mm, length.std_mm, *interval)
            rows.append([row, track_id, *("" if v is None else v for v in values)])
    with replacing(path) as draft:
        write_table(draft, _COLUMNS, rows)


def is_saved(method: str, scene: int, *, cache: Path) -> bool:
    """Whether this part has been measured."""
    return _path(cache, method, scene).exists()


def forget(method: str, *, cache: Path) -> None:
    """Measure a method again."""
    for path in (cache / method).glob("*.csv"):
        path.unlink()


def load(method: str, scenes: Iterable[int], *, cache: Path) -> dict[str, list[Fish]]:
    """The fish of those scenes that have been measured, by row."""
    rows: dict[str, list[Fish]] = {}
    for scene in scenes:
        if not is_saved(method, scene, cache=cache):
            continue
        with _path(cache, method, scene).open(newline="", encoding="utf-8") as file:
            for record in csv.DictReader(file):
                fish = Fish(scene, int(record["track_id"]), float(record["truth_mm"]), _row(record))
                rows.setdefault(record["row"], []).append(fish)
    return rows


def age_hours(method: str, *, cache: Path) -> float:
    """Hours since the oldest part of a method was measured."""
    times = [path.stat().st_mtime for path in (cache / method).glob("*.csv")]
    return (time.time() - min(times)) / 3600 if times else 0.0


def _path(cache: Path, method: str, scene: int) -> Path:
    return cache / method / f"{scene:03d}.csv"


def _row(record: dict[str, str]) -> LengthRow:
    length, std, low, high = (
        float(record[name]) if record[name] else None for name in _COLUMNS[3:]
    )
    ci95_mm = None if low is None or high is None else (low, high)
    return LengthRow(length_mm=length, std_mm=std, ci95_mm=ci95_mm)
