"""Positions of a file: NMEA 0183 with dates, or CSV."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from stream_dmr.errors import SourceError, reason_of
from stream_dmr.messages import Frame, Position
from stream_dmr.sensors.fix_builder import Fix, FixBuilder, JumpGate, PositionCounts
from stream_dmr.sensors.position_source import PositionSource, position
from stream_dmr.sensors.sensors_settings import SensorsSettings, utc_ns_of

_CSV_COLUMNS = ("time_utc", "latitude", "longitude")
_OPTIONAL_COLUMNS = ("speed_knots", "course_deg")


class PositionFile(PositionSource):
    """Read as frames pass, so that it may be longer than memory is large.

    A `.csv` has the columns time_utc (ISO 8601), latitude, longitude and perhaps speed_knots and
    course_deg; any other file is read as lines of NMEA 0183, whose RMC or GGA say the time.
    """

    def __init__(self, path: Path, settings: SensorsSettings, *, is_since_1970: bool) -> None:
        """`is_since_1970`: the frames have times of day, a video's begin with 0.

        Raises SourceError where there is no position in it, or a video's start is not known.
        """
        zero_ns = settings.offset_ns if is_since_1970 else settings.zero_utc_ns
        if zero_ns is None:
            raise SourceError(
                f"--nmea {path}: expected to know when the video began, got no [sensors] start_utc "
                'in config.toml; add start_utc = "2026-11-22T06:00:00Z" with its time'
            )
        self.name = path.name
        self._path, self._zero_ns = path, zero_ns
        self._max_gap_ns = round(settings.max_gap_s * 1e9)
        reference_ns = None if is_since_1970 else zero_ns
        self._builder = FixBuilder(settings, now_ns=lambda: reference_ns)
        self._gate = JumpGate(settings.max_speed_knots)  # of a CSV
        self._file = _opened(path)
        self._positions = self._in_order()
        self._next = next(self._positions, None)
        self._last_frame = 0
        self._is_begun = False
        if self._next is None:
            self.close()
            raise SourceError(
                f"--nmea {path}: expected positions (RMC or GGA with dates, or CSV with "
                f"{','.join(_CSV_COLUMNS)}), found none: {self.counts.left_out() or 'it is empty'}"
            )

    @property
    def counts(self) -> PositionCounts:
        """What was read so far."""
        return self._builder.counts

    def take(self, frame: Frame) -> Sequence[Position]:
        """The positions up to a frame; of those before the first one only the last."""
        found: list[Position] = []
        self._last_frame = frame.frame_index
        while self._next is not None and self._next[0] <= frame.timestamp_ns:
            found.append(self._message(self._next))
            self._next = next(self._positions, None)
        if not self._is_begun:
            self._is_begun = True
            found = found[-1:]
            if found and frame.timestamp_ns - found[0].timestamp_ns > self._max_gap_ns:
                return []
        return found

    def finish(self) -> Sequence[Position]:
        """The next position, if any: what lies before it is interpolated."""
        return [] if self._next is None else [self._message(self._next)]

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _message(self, timed: tuple[int, Fix]) -> Position:
        return position(timed[1], timestamp_ns=timed[0], frame_index=self._last_frame)

    def _in_order(self) -> Iterator[tuple[int, Fix]]:
        """Time on the clock of the frames, increasing, and fix; others are counted as jumps."""
        last_ns: int | None = None
        waiting: tuple[int, Fix] | None = None  # a wrong first date is known by what follows it
        for fix in self._csv_fixes() if self._path.suffix.lower() == ".csv" else self._nmea_fixes():
            time_ns = (fix.utc_ns or 0) - self._zero_ns
            if waiting is not None and time_ns > waiting[0]:
                last_ns = waiting[0]
                yield waiting
            elif waiting is not None:
                self._leave_out()
            waiting = time_ns, fix
            if last_ns is not None and time_ns <= last_ns:
                self._leave_out()
                waiting = None
        if waiting is not None:
            yield waiting

    def _leave_out(self) -> None:
        self.counts.positions -= 1
        self.counts.jumps += 1

    def _nmea_fixes(self) -> Iterator[Fix]:
        for line in self._file:
            if (fix := self._builder.take(line)) is not None:
                yield fix

    def _csv_fixes(self) -> Iterator[Fix]:
        reader = csv.DictReader(line.decode("utf-8-sig", "replace") for line in self._file)
        missing = [name for name in _CSV_COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            self.close()
            raise SourceError(
                f"--nmea {self._path}: expected the columns {','.join(_CSV_COLUMNS)} (and perhaps "
                f"{','.join(_OPTIONAL_COLUMNS)}), got {','.join(reader.fieldnames or ()) or 'none'}"
            )
        for row in reader:
            self.counts.sentences += 1
            fix = _csv_fix(row)
            if fix is None:
                self.counts.unreadable += 1
            elif not self._gate.lets_pass(fix, fix.utc_ns or 0):
                self.counts.jumps += 1
            else:
                self.counts.positions += 1
                yield fix


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise SourceError(
            f"--nmea {path}: expected a file of positions, got: {reason_of(error)}"
        ) from error


def _csv_fix(row: dict[str, str]) -> Fix | None:
    """The position of a row; None where a cell is no time or no place on the earth."""
    try:
        optional = {name: float(row[name]) for name in _OPTIONAL_COLUMNS if row.get(name)}
        latitude, longitude = float(row["latitude"]), float(row["longitude"])
        utc_ns = utc_ns_of(row["time_utc"])
    except (ValueError, TypeError):
        return None
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        return None
    return Fix(utc_ns=utc_ns, latitude=latitude, longitude=longitude, **optional)
