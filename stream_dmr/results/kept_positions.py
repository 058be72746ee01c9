"""The positions that lengths.db keeps: fewer than came, and it is known where some are missing."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from stream_dmr.messages import Position
from stream_dmr.results.added_tables import AddedTable, read_added

POSITIONS = AddedTable(
    name="positions",
    kind="position",
    columns="""
    run_id TEXT NOT NULL REFERENCES runs,
    timestamp_ns INTEGER NOT NULL, -- on the clock of the frames
    utc_ns INTEGER, -- the receiver's, since 1970; NULL: it gave no date
    latitude REAL NOT NULL, longitude REAL NOT NULL, -- degrees, WGS 84
    speed_knots REAL, course_deg REAL, -- over ground
    is_joined INTEGER NOT NULL, -- 0: positions are missing between the row before and this one
    written_ns INTEGER NOT NULL -- wall clock
""",
)


@dataclass(frozen=True, kw_only=True)
class KeptPosition:
    """One row of `positions`, without the run and the time of writing."""

    timestamp_ns: int
    utc_ns: int | None
    latitude: float
    longitude: float
    speed_knots: float | None
    course_deg: float | None
    is_joined: bool  # may be interpolated from the one before


_NAMES = [field.name for field in fields(KeptPosition)]


class PositionThinner:
    """Keeps a position every `keep_s`, and those at both ends of a gap."""

    def __init__(self, *, keep_s: float, max_gap_s: float) -> None:
        """Positions further apart than `max_gap_s` have a gap between them."""
        self._keep_ns, self._max_gap_ns = round(keep_s * 1e9), round(max_gap_s * 1e9)
        self._kept: KeptPosition | None = None  # the last one
        self._last: Position | None = None  # the last one that came
        self.gap_s = 0.0  # before the last one that came, where that is a gap

    def take(self, position: Position) -> list[KeptPosition]:
        """The positions to keep now, in their order."""
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
        """The last position, where it was not kept."""
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
    """The columns of a row."""
    return asdict(kept) | {"is_joined": int(kept.is_joined)}


def read_positions(database: Path) -> list[KeptPosition]:
    """All positions of a lengths.db, in the order of writing. Raises OutputError."""
    return positions_of(read_added(database, POSITIONS))


def positions_of(rows: Sequence[Mapping[str, Any]]) -> list[KeptPosition]:
    """The rows of the table as positions."""
    return [
        KeptPosition(
            **{name: row[name] for name in _NAMES if name != "is_joined"},
            is_joined=bool(row["is_joined"]),
        )
        for row in rows
    ]


def kept_of(
    positions: Iterable[Position], *, keep_s: float, max_gap_s: float
) -> Iterator[KeptPosition]:
    """Those of a recording that a lengths.db would have."""
    thinner = PositionThinner(keep_s=keep_s, max_gap_s=max_gap_s)
    for position in positions:
        yield from thinner.take(position)
    yield from thinner.finish()
