"""Hauls, positions and the track of the vessel."""

import sqlite3
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from stream_dmr.messages import Position
from stream_dmr.store.schema import POSITIONS, reading, rows

START, END = "start", "end"


@dataclass(frozen=True, kw_only=True)
class Haul:
    """One haul, by its times on the clock of the frames."""

    name: str
    began_ns: int
    ended_ns: int | None = None  # None while it continues

    def includes(self, timestamp_ns: int) -> bool:
        return self.began_ns <= timestamp_ns and (
            self.ended_ns is None or timestamp_ns < self.ended_ns
        )


def hauls_of(rows: Iterable[Mapping[str, Any]]) -> list[Haul]:
    """The hauls that rows of `hauls` make, in their order.

    A start ends the haul before it; an end without a start means nothing.
    """
    hauls: list[Haul] = []
    for row in sorted(rows, key=lambda row: row["timestamp_ns"]):
        if hauls and hauls[-1].ended_ns is None:
            hauls[-1] = replace(hauls[-1], ended_ns=row["timestamp_ns"])
        if row["what"] == START:
            hauls.append(Haul(name=row["name"], began_ns=row["timestamp_ns"]))
    return hauls


def haul_at(hauls: Sequence[Haul], timestamp_ns: int) -> str:
    """The name of the haul at a time; "" between hauls. `hauls` are as of `hauls_of`."""
    index = bisect_right(hauls, timestamp_ns, key=lambda haul: haul.began_ns) - 1
    return hauls[index].name if index >= 0 and hauls[index].includes(timestamp_ns) else ""


def next_name(hauls: Iterable[Haul]) -> str:
    """The number of a haul without a name: the next after the highest so far."""
    numbers = [int(haul.name) for haul in hauls if haul.name.isdecimal()]
    return str(max(numbers, default=0) + 1)


def haul_values(what: str, name: str, timestamp_ns: int, said_by: str) -> dict[str, Any]:
    """The columns of an event, without the run and the time of writing."""
    return {"what": what, "name": name, "timestamp_ns": timestamp_ns, "said_by": said_by}


@dataclass(frozen=True, kw_only=True)
class KeptPosition:
    """One row of `positions`, without the run and the time of writing."""

    timestamp_ns: int
    utc_ns: int | None
    latitude: float
    longitude: float
    speed_knots: float | None
    course_deg: float | None
    is_joined: bool  # may be interpolated from the position before


_NAMES = [field.name for field in fields(KeptPosition)]


class PositionThinner:
    """Keeps a position every `keep_s`, and the positions at both ends of a gap."""

    def __init__(self, *, keep_s: float, max_gap_s: float) -> None:
        """Positions further apart than `max_gap_s` have a gap between them."""
        self._keep_ns, self._max_gap_ns = round(keep_s * 1e9), round(max_gap_s * 1e9)
        self._kept: KeptPosition | None = None  # the last kept position
        self._last: Position | None = None  # the last position that came
        self.gap_s = 0.0  # before the last position that came, if that is a gap

    def take(self, position: Position) -> list[KeptPosition]:
        last, self._last = self._last, position
        self.gap_s = 0.0
        if last is None or self._kept is None:
            return [self._keep(position, is_joined=False)]
        if position.timestamp_ns <= last.timestamp_ns:  # a clock was set back: not in order
            self._last = last
            return []
        if position.timestamp_ns - last.timestamp_ns > self._max_gap_ns:
            self.gap_s = (position.timestamp_ns - last.timestamp_ns) / 1e9
            return [*self._keep_last(last), self._keep(position, is_joined=False)]
        if position.timestamp_ns - self._kept.timestamp_ns < self._keep_ns:
            return []
        if position.timestamp_ns - self._kept.timestamp_ns > self._max_gap_ns:  # keep_s is longer
            return [*self._keep_last(last), self._keep(position, is_joined=True)]
        return [self._keep(position, is_joined=True)]

    def finish(self) -> list[KeptPosition]:
        """The last position, if it was not kept."""
        return [] if self._last is None else self._keep_last(self._last)

    def _keep_last(self, last: Position) -> list[KeptPosition]:
        if self._kept is not None and last.timestamp_ns > self._kept.timestamp_ns:
            return [self._keep(last, is_joined=True)]
        return []

    def _keep(self, position: Position, *, is_joined: bool) -> KeptPosition:
        values = {name: getattr(position, name) for name in _NAMES if name != "is_joined"}
        self._kept = KeptPosition(**values, is_joined=is_joined)
        return self._kept


def position_values(kept: KeptPosition) -> Mapping[str, object]:
    return asdict(kept) | {"is_joined": int(kept.is_joined)}


def read_positions(database: Path) -> list[KeptPosition]:
    """All positions of a lengths.db, in the order of writing. Raises OutputError."""
    with reading(database) as connection:
        return positions_of(connection)


def positions_of(database: sqlite3.Connection) -> list[KeptPosition]:
    """The positions of an open lengths.db, in the order of writing."""
    return [
        KeptPosition(**{n: row[n] for n in _NAMES} | {"is_joined": bool(row["is_joined"])})
        for row in rows(database, POSITIONS)
    ]


def thinned(positions: Sequence[KeptPosition], *, most: int) -> list[KeptPosition]:
    """Every n-th position, so that at most so many are left; between two of them gaps stay gaps."""
    step = max(1, -(-len(positions) // most))
    starts = range(0, len(positions), step)
    passed = (positions[max(0, i - step + 1) : i + 1] for i in starts)
    return [replace(run[-1], is_joined=all(each.is_joined for each in run)) for run in passed]


def kept_of(
    positions: Iterable[Position], *, keep_s: float, max_gap_s: float
) -> Iterator[KeptPosition]:
    """The positions of a recording that a lengths.db would have."""
    thinner = PositionThinner(keep_s=keep_s, max_gap_s=max_gap_s)
    for position in positions:
        yield from thinner.take(position)
    yield from thinner.finish()


@dataclass(frozen=True, kw_only=True)
class Whereabouts:
    """Place, speed and time of one moment; None if unknown."""

    utc_ns: int | None = None
    latitude: float | None = None  # degrees, WGS 84
    longitude: float | None = None
    speed_knots: float | None = None
    gap_s: float | None = None  # between the positions around it, if that is too long


NOWHERE = Whereabouts()


class VesselTrack:
    """The positions of a folder, by their time on the clock of the frames."""

    def __init__(self, positions: Iterable[KeptPosition]) -> None:
        by_time = {kept.timestamp_ns: kept for kept in positions}  # a resumed video has some twice
        self.positions = [by_time[time_ns] for time_ns in sorted(by_time)]
        self._times_ns = [kept.timestamp_ns for kept in self.positions]

    def at(self, timestamp_ns: int) -> Whereabouts:
        """Place of the vessel; linear between two positions, the short way round the earth."""
        index = bisect_left(self._times_ns, timestamp_ns)
        if index < len(self.positions) and self._times_ns[index] == timestamp_ns:
            kept = self.positions[index]
            place = {"latitude": kept.latitude, "longitude": kept.longitude}
            return Whereabouts(utc_ns=kept.utc_ns, speed_knots=kept.speed_knots, **place)
        if not 0 < index < len(self.positions):
            return NOWHERE
        before, after = self.positions[index - 1], self.positions[index]
        span_ns = after.timestamp_ns - before.timestamp_ns
        if not after.is_joined:
            return Whereabouts(gap_s=span_ns / 1e9)
        share = (timestamp_ns - before.timestamp_ns) / span_ns
        turn = (after.longitude - before.longitude + 180) % 360 - 180
        utc_ns = speed_knots = None
        if before.utc_ns is not None and after.utc_ns is not None:
            # In integers: a double has no nanoseconds of the year.
            passed_ns = timestamp_ns - before.timestamp_ns
            utc_ns = before.utc_ns + (after.utc_ns - before.utc_ns) * passed_ns // span_ns
        if before.speed_knots is not None and after.speed_knots is not None:
            speed_knots = before.speed_knots + share * (after.speed_knots - before.speed_knots)
        return Whereabouts(
            utc_ns=utc_ns,
            latitude=before.latitude + share * (after.latitude - before.latitude),
            longitude=(before.longitude + share * turn + 180) % 360 - 180,
            speed_knots=speed_knots,
        )

    def pieces(self) -> list[Sequence[KeptPosition]]:
        """The track, cut at its gaps."""
        pieces: list[list[KeptPosition]] = []
        for kept in self.positions:
            if not (kept.is_joined and pieces):
                pieces.append([])
            pieces[-1].append(kept)
        return [*pieces]
