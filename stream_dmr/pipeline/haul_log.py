"""Hauls that begin and end, during a run and after it."""

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from stream_dmr.errors import OutputError, UserError
from stream_dmr.evidence.seal import seal_hauls
from stream_dmr.files import is_locked
from stream_dmr.messages import LengthEstimate, Position
from stream_dmr.pipeline.config import HaulsSettings
from stream_dmr.sources.sensors_settings import utc_ns_of
from stream_dmr.store.fish import database_of, read_runs
from stream_dmr.store.length_store import MARK_EVERY_NS, LengthStore
from stream_dmr.store.schema import CLIPS, HAULS, MARKS, WATCHED, add_row, read_rows
from stream_dmr.store.trip import END, START, Haul, haul_at, haul_values, hauls_of, next_name

_RULE = "rule"
_FAST_NS = 60_000_000_000  # time that the vessel must be fast; chosen
_WATCHED_NS = 60_000_000_000  # longest time in a row of `watched`: a crash loses the last row
_PAUSE_NS = 10_000_000_000  # between two frames; a longer pause ends a row of `watched`


class HaulLog:
    """Keeps the hauls of a run, and begins and ends hauls by rule.

    Thread-safe: called in the threads of the chain and of the server.
    """

    def __init__(
        self,
        store: LengthStore,
        settings: HaulsSettings,
        *,
        frames_lost: Callable[[], int] = lambda: 0,
    ) -> None:
        """`frames_lost`: frames of the camera so far that the chain did not get."""
        self._frames_lost = frames_lost
        self._store = store
        self._pause_ns = round(settings.pause_min * 60e9)
        self._fast_knots = settings.end_speed_knots or float("inf")
        self._lock = threading.RLock()
        self._rows: list[dict[str, Any]] = []  # of `hauls`, to which rows are only added
        self._known: list[Haul] = []
        self._ruled: str | None = None  # the haul that the rule began and has not ended
        self._last_fish_ns = 0
        self._in_view: dict[int, int] = {}  # tracks that have not ended, and when they began
        self._in_chain: deque[int] = deque()  # capture times of the frames in the chain, in order
        self._fast_since_ns: int | None = None
        self._now_ns = 0  # capture time of the latest frame
        self._watched: dict[str, int] | None = None  # the next row of `watched`
        self._lost_before = 0
        self._take_over()

    def _take_over(self) -> None:
        """Go on with a haul that the rule began and a crash left open: nobody else would end it."""
        with suppress(OutputError):
            haul = self.current()
            ruled = {row["timestamp_ns"] for row in self._rows if row["said_by"] == _RULE}
            if haul is not None and haul.began_ns in ruled:
                lasts = (fish.last_timestamp_ns for fish in self._store.estimates())
                self._ruled, self._last_fish_ns = haul.name, max([haul.began_ns, *lasts])

    def hauls(self) -> list[Haul]:
        """All hauls of the folder so far, also those that other programs wrote into it."""
        with self._lock, suppress(OutputError):
            after = self._rows[-1]["number"] if self._rows else 0
            if told := self._store.rows(HAULS, after=after):
                self._rows += told
                self._known = hauls_of(self._rows)
        return self._known

    def current(self) -> Haul | None:
        hauls = self.hauls()
        return hauls[-1] if hauls and hauls[-1].ended_ns is None else None

    def mark(self, what: str, name: str = "", *, said_by: str) -> str:
        """Begin or end a haul now; returns its name. Raises UserError if that makes no sense."""
        with self._lock:
            current, timestamp_ns = self.current(), self._now_ns
            if what == START:
                name = name.strip() or next_name(self.hauls())
            elif what == END and current is not None:
                name = current.name
                # By a command it may have begun after the last frame: the camera is silent.
                timestamp_ns = max(timestamp_ns, current.began_ns + 1)
            else:
                raise UserError(
                    f"haul: expected start, or end of a haul that goes on, got {what!r}; "
                    "begin one first"
                )
            self._ruled = None
            self._add(what, name, timestamp_ns, said_by)
            return name

    def take_frame(self, timestamp_ns: int) -> None:
        """Take a frame that enters the chain, whose fish are not known yet."""
        with self._lock:
            self._watch(timestamp_ns, self._frames_lost())
            self._now_ns = timestamp_ns
            self._in_chain.append(timestamp_ns)

    def frame_done(self) -> None:
        """Take note that a frame has left the last stage: all fish that began by then are known.

        A rule uses these frames alone. The camera is ahead of them, after a pause by hours.
        """
        with self._lock:
            pause_ns = self._in_chain.popleft() - self._last_fish_ns
            if self._ruled is not None and not self._in_view and pause_ns > self._pause_ns:
                self._end_ruled(self._last_fish_ns)

    def take_fish(self, estimate: LengthEstimate) -> None:
        """Take the next frame of a fish, or the end of its track."""
        with self._lock:
            self._last_fish_ns = max(self._last_fish_ns, estimate.last_timestamp_ns)
            self._in_view.setdefault(estimate.track_id, estimate.first_timestamp_ns)
            if not estimate.is_final:
                return
            if self._pause_ns and self._ruled is None and self.current() is None:
                # From the first frame of any fish in view: it may have come before this fish. But
                # a haul that people ended meanwhile keeps its end, and its fish.
                ends = [haul.ended_ns or 0 for haul in self._known]
                past_ns = max((end_ns for end_ns in ends if end_ns <= self._now_ns), default=0)
                if self._last_fish_ns > past_ns:
                    self._ruled = next_name(self._known)
                    self._add(START, self._ruled, max(min(self._in_view.values()), past_ns), _RULE)
            del self._in_view[estimate.track_id]

    def take_position(self, position: Position) -> None:
        with self._lock:
            if position.speed_knots is None or position.speed_knots <= self._fast_knots:
                self._fast_since_ns = None
                return
            self._fast_since_ns = self._fast_since_ns or position.timestamp_ns
            if self._ruled and position.timestamp_ns - self._fast_since_ns >= _FAST_NS:
                self._end_ruled(self._fast_since_ns)

    def finish(self) -> None:
        with self._lock:
            self._write_watched(is_urgent=True)  # the digest of the last day reads it at once
            self._end_ruled(self._last_fish_ns)

    def _end_ruled(self, timestamp_ns: int) -> None:
        current = self.current() if self._ruled is not None else None
        # A command may have ended that haul meanwhile, or begun another, which is not the rule's.
        if current is not None and current.name == self._ruled:
            self._add(END, current.name, max(timestamp_ns, self._last_fish_ns) + 1, _RULE)
        self._ruled = None

    def _add(self, what: str, name: str, timestamp_ns: int, said_by: str) -> None:
        self._store.append(HAULS, name, haul_values(what, name, timestamp_ns, said_by))

    def _watch(self, timestamp_ns: int, lost: int) -> None:
        new_lost, self._lost_before = max(0, lost - self._lost_before), lost
        if self._watched is not None:
            if timestamp_ns - self._watched["last_ns"] > _PAUSE_NS:
                self._write_watched()
            elif timestamp_ns - self._watched["first_ns"] > _WATCHED_NS:
                self._watched["last_ns"] = timestamp_ns
                self._write_watched()
        if self._watched is None:
            self._watched = {"first_ns": timestamp_ns, "last_ns": 0, "frames": 0, "frames_lost": 0}
        self._watched["last_ns"] = timestamp_ns
        self._watched["frames"] += 1
        self._watched["frames_lost"] += new_lost

    def _write_watched(self, *, is_urgent: bool = False) -> None:
        if self._watched is not None:
            name = str(self._watched["first_ns"])
            self._store.append(WATCHED, name, self._watched, is_urgent=is_urgent)
        self._watched = None


_MAX_SECONDS = 9e9  # seconds that 64 bits of nanoseconds hold: the year 2255


def write_haul(folder: Path, what: str, *, name: str, at: str | None, said_by: str) -> str:
    """Begin or end a haul; returns its name. `at` as in `stream-dmr haul`. Raises UserError."""
    database = database_of(folder)
    if database is None:
        raise UserError(
            f"{folder}: expected the --out of a run, found no lengths.db; check the path"
        )
    hauls = hauls_of(read_rows(database, HAULS))
    timestamp_ns = _timestamp_ns(folder, database, at)
    if what == END:
        name = haul_at(hauls, timestamp_ns)
        if not name:
            raise UserError(
                f"{folder}: expected a haul that goes on at that time, got none; begin one first"
            )
    name = name.strip() or next_name(hauls)
    row = haul_values(what, name, timestamp_ns, said_by)
    add_row(database, HAULS, {"run_id": "", **row, "written_ns": time.time_ns()})
    if not is_locked(folder):
        seal_hauls(folder)
    return name


def _timestamp_ns(folder: Path, database: Path, at: str | None) -> int:
    """A time that the user gave, on the clock of the frames."""
    seconds = _seconds(at)
    if seconds is not None:
        return round(seconds * 1e9)
    run = next(reversed(read_runs(database).values()), None)
    if at is None and not is_locked(folder):
        raise UserError(f"{folder}: no run goes on here; say when, with --at")
    if run is None or run.utc_zero_ns is None:
        raise UserError(
            f"{folder}: its run does not know the time of day of its frames; give --at in seconds, "
            "as in lengths.csv"
        )
    if at is None:
        wall_ns = time.time_ns() - run.utc_zero_ns
        return _now_ns(database, wall_ns, has_frames=bool(run.frames_done))
    try:
        return utc_ns_of(at) - run.utc_zero_ns
    except ValueError as error:
        raise UserError(f"--at: expected {error}") from error


def _now_ns(database: Path, wall_ns: int, *, has_frames: bool) -> int:
    """Now on the clock of the frames: that of a camera goes on evenly if this machine's is set."""
    if read_rows(database, CLIPS):  # clips may be measured long after they came
        return wall_ns
    marks = {row["name"]: row["value"] for row in read_rows(database, MARKS)}
    last_ns = marks.get("timestamp_ns", 0)
    now_ns = max(wall_ns, last_ns)  # while no frame came, the mark is that of a run before
    return min(now_ns, last_ns + MARK_EVERY_NS) if has_frames else now_ns


def _seconds(at: str | None) -> float | None:
    """`at` as seconds; None if it is no number. Raises UserError if it is out of range."""
    try:
        seconds = float(at or "")
    except ValueError:
        return None
    if not abs(seconds) < _MAX_SECONDS:
        raise UserError(f"--at: expected seconds as in lengths.csv, got {at}")
    return seconds
