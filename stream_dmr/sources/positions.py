"""Positions of the vessel, from NMEA 0183 sentences."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from datetime import date, time
from typing import Any

from pynmeagps import NMEAReader
from pynmeagps.exceptions import NMEAMessageError, NMEAParseError, NMEATypeError
from pynmeagps.nmeahelpers import calc_checksum, get_parts

from stream_dmr.errors import UserError
from stream_dmr.messages import Frame, Position
from stream_dmr.sources.sensors_settings import SensorsSettings

_KINDS = ("RMC", "GGA")
_MEASURED_MODES = ("", "A", "D", "F", "P", "R")  # not estimated, typed in, or simulated
_MEASURED_QUALITIES = (1, 2, 3, 4, 5)  # of GGA, likewise
_MAX_BYTES = 120  # of a sentence; the standard has 82


class WrongChecksumError(UserError):
    """A sentence whose checksum does not match its text."""


@dataclass(frozen=True, kw_only=True)
class PositionSentence:
    """An RMC or GGA sentence; None for its empty fields."""

    kind: str  # "RMC" or "GGA"
    day: date | None  # UTC; a GGA has none
    time_of_day_ns: int | None  # UTC
    latitude: float | None  # degrees, WGS 84, north positive
    longitude: float | None  # east positive
    speed_knots: float | None = None  # over ground
    course_deg: float | None = None  # over ground, clockwise from true north
    is_fix: bool  # the receiver claims to have measured this position


def read_sentence(line: bytes) -> PositionSentence | None:
    """The position in a line; None for sentences of other kinds.

    Raises WrongChecksumError, and ValueError if it is no sentence.
    """
    text = line.strip()
    if len(text) > _MAX_BYTES:
        raise ValueError("it is longer than a sentence may be")
    try:
        content, _, kind, _, checksum = get_parts(text)
    except NMEAMessageError as error:
        raise ValueError("it is no sentence of NMEA 0183") from error
    if text[:1] != b"$" and text[:1] != b"!":
        raise ValueError("it does not begin with $")
    if calc_checksum(content.lstrip("!")) != checksum[:2].upper():
        raise WrongChecksumError(f"{content}: its checksum is not {checksum}")
    return _position(kind, text) if kind in _KINDS else None


def _position(kind: str, text: bytes) -> PositionSentence:
    try:
        message: Any = NMEAReader.parse(text)
    except (NMEAParseError, NMEAMessageError, NMEATypeError) as error:
        raise ValueError(f"its fields can't be read: {error}") from error
    if message is None:
        raise ValueError("its fields can't be read")
    is_measured = (
        message.status == "A" and getattr(message, "posMode", "") in _MEASURED_MODES
        if kind == "RMC"
        else message.quality in _MEASURED_QUALITIES
    )
    latitude, longitude = _degrees(message.lat, 90.0), _degrees(message.lon, 180.0)
    day, at, time_of_day_ns = getattr(message, "date", None), message.time, None
    if isinstance(at, time):
        seconds = (at.hour * 60 + at.minute) * 60 + at.second
        time_of_day_ns = seconds * 1_000_000_000 + at.microsecond * 1000
    return PositionSentence(
        kind=kind,
        day=day if isinstance(day, date) else None,
        time_of_day_ns=time_of_day_ns,
        latitude=latitude,
        longitude=longitude,
        speed_knots=_number(getattr(message, "spd", None)),
        course_deg=_number(getattr(message, "cog", None)),
        is_fix=is_measured and latitude is not None and longitude is not None,
    )


def _degrees(value: object, limit: float) -> float | None:
    number = _number(value)
    return number if number is not None and abs(number) <= limit else None


def _number(value: object) -> float | None:
    """A field as a number; pynmeagps returns an empty field as text."""
    return float(value) if isinstance(value, int | float) else None


_DAY_NS = 86_400_000_000_000
_ROLL_OVER_NS = 1024 * 7 * _DAY_NS  # GPS counts weeks modulo 1024
_RMC_EVERY_NS = 5_000_000_000  # a receiver that sends RMC at least so often needs no GGA; chosen
_NOISE_M = 50.0  # between two positions of a vessel that lies still; chosen
_TIME_JUMP_S = 60.0  # more than sentences are late; chosen
_AGREEING = 3  # so many positions after a jump that agree with each other are the truth; chosen
_EARTH_M = 6_371_008.8  # mean radius, IUGG
_M_PER_S = 1852 / 3600  # a knot


@dataclass(kw_only=True)
class PositionCounts:
    """Counts of the sentences of a receiver or a file, and of those left out."""

    sentences: int = 0  # lines, of any kind
    positions: int = 0  # that are used
    wrong_checksum: int = 0
    unreadable: int = 0
    without_fix: int = 0  # the receiver said itself that it had no position
    without_date: int = 0
    jumps: int = 0  # further away than a vessel gets, or back in time, or a jump of it
    roll_overs: int = 0  # dates 1024 weeks off, put right
    reconnects: int = 0
    last_arrival_ns: int = 0  # of any sentence, monotonic clock; 0: none so far
    last_position_ns: int = 0  # likewise, of a position

    def left_out(self) -> str:
        """The counts of sentences left out, in words; "" if there are none."""
        words = {
            "wrong_checksum": "with a wrong checksum",
            "unreadable": "unreadable",
            "without_fix": "without a position",
            "without_date": "without a date",
            "jumps": "too far from the one before, or of a time that jumps",
        }
        found = [(getattr(self, field.name), words.get(field.name)) for field in fields(self)]
        parts = [f"{count} {text}" for count, text in found if count and text]
        if self.roll_overs:
            parts.append(f"{self.roll_overs} dates 1024 weeks off, put right")
        return ", ".join(parts)


COUNTED = [field.name for field in fields(PositionCounts) if not field.name.endswith("_ns")]


@dataclass(frozen=True, kw_only=True)
class Fix:
    """One position as a receiver gave it; degrees, WGS 84."""

    utc_ns: int | None  # its own time, ns since 1970; None without a date
    latitude: float
    longitude: float
    speed_knots: float | None = None
    course_deg: float | None = None


class FixBuilder:
    """Takes the lines of one receiver in their order. No I/O."""

    def __init__(
        self, settings: SensorsSettings, *, now_ns: Callable[[], int | None] = lambda: None
    ) -> None:
        """`now_ns` returns the approximate UTC of the next sentence by another clock, or None."""
        self.counts = PositionCounts()
        self._now_ns = now_ns
        self._gate = JumpGate(settings.max_speed_knots)
        self._last_utc_ns: int | None = None
        self._last_rmc_ns: int | None = None  # its time of day

    def take(self, line: bytes, *, arrival_ns: int | None = None) -> Fix | None:
        """The position in a line; None if it has none, or none that is plausible.

        `arrival_ns`: on a clock that runs evenly; None: the receiver's own time is such a clock,
        and positions without it are of no use.
        """
        if not line.strip():
            return None
        self.counts.sentences += 1
        try:
            sentence = read_sentence(line)
        except WrongChecksumError:
            self.counts.wrong_checksum += 1
            return None
        except ValueError:
            self.counts.unreadable += 1
            return None
        if sentence is None or self._is_repeated(sentence):
            return None
        fix = self._fix(sentence)
        if fix is None:
            self.counts.without_fix += 1
            return None
        moment_ns = fix.utc_ns if arrival_ns is None else arrival_ns
        if moment_ns is None:
            self.counts.without_date += 1
            return None
        if arrival_ns is None and fix.utc_ns == self._last_utc_ns:  # a GGA and an RMC of a moment
            return None
        if not self._gate.lets_pass(fix, moment_ns):
            self.counts.jumps += 1
            return None
        self._last_utc_ns = fix.utc_ns
        self.counts.positions += 1
        return fix

    def _is_repeated(self, sentence: PositionSentence) -> bool:
        """True for a GGA of a receiver that sends RMC as well, which contains more."""
        now_ns = sentence.time_of_day_ns
        if sentence.kind == "RMC":
            self._last_rmc_ns = now_ns
            return False
        if now_ns is None or self._last_rmc_ns is None:
            return False
        return (now_ns - self._last_rmc_ns) % _DAY_NS < _RMC_EVERY_NS

    def _fix(self, sentence: PositionSentence) -> Fix | None:
        if not sentence.is_fix or sentence.latitude is None or sentence.longitude is None:
            return None
        return Fix(
            utc_ns=self._utc_ns(sentence),
            latitude=sentence.latitude,
            longitude=sentence.longitude,
            speed_knots=sentence.speed_knots,
            course_deg=sentence.course_deg,
        )

    def _utc_ns(self, sentence: PositionSentence) -> int | None:
        if sentence.time_of_day_ns is None:
            return None
        if sentence.day is not None:
            days = sentence.day.toordinal() - _EPOCH_DAY
            return self._without_roll_over(days * _DAY_NS + sentence.time_of_day_ns)
        near_ns = self._last_utc_ns if self._last_utc_ns is not None else self._now_ns()
        if near_ns is None:
            return None
        return near_ns + _centred(sentence.time_of_day_ns - near_ns, _DAY_NS)

    def _without_roll_over(self, utc_ns: int) -> int:
        """Correct a date that is off by 1024 weeks, to within a day of the other clock."""
        now_ns = self._now_ns()
        if now_ns is None or abs(utc_ns - now_ns) < _ROLL_OVER_NS // 2:
            return utc_ns
        rest_ns = _centred(utc_ns - now_ns, _ROLL_OVER_NS)
        if abs(rest_ns) > _DAY_NS:
            return utc_ns
        self.counts.roll_overs += 1
        return now_ns + rest_ns


_EPOCH_DAY = 719_163  # date(1970, 1, 1).toordinal()


class JumpGate:
    """Leaves out positions that no vessel gets to, until several of them agree."""

    def __init__(self, max_speed_knots: float) -> None:
        self._max_m_per_s = max_speed_knots * _M_PER_S
        self._last: tuple[Fix, int] | None = None
        self._doubtful: list[tuple[Fix, int]] = []

    def lets_pass(self, fix: Fix, moment_ns: int) -> bool:
        """True for a position that follows from the last, or from the last few that did not."""
        now = fix, moment_ns
        if self._last is not None and not self._follows(self._last, now):
            if self._doubtful and not self._follows(self._doubtful[-1], now):
                self._doubtful.clear()
            self._doubtful.append(now)
            if len(self._doubtful) < _AGREEING:
                return False
        self._last = now
        self._doubtful.clear()
        return True

    def _follows(self, before: tuple[Fix, int], now: tuple[Fix, int]) -> bool:
        seconds = (now[1] - before[1]) / 1e9
        if before[0].utc_ns is not None and now[0].utc_ns is not None:  # of a receiver
            utc_s = (now[0].utc_ns - before[0].utc_ns) / 1e9
            if abs(utc_s - seconds) > _TIME_JUMP_S:
                return False
        reach_m = self._max_m_per_s * seconds + _NOISE_M
        return seconds >= 0 and distance_m(before[0], now[0]) <= reach_m


def distance_m(first: Fix, second: Fix) -> float:
    """Great-circle distance on a sphere, m (haversine)."""
    lat0, lat1 = math.radians(first.latitude), math.radians(second.latitude)
    half_lat, half_lon = (lat1 - lat0) / 2, math.radians(second.longitude - first.longitude) / 2
    share = math.sin(half_lat) ** 2 + math.cos(lat0) * math.cos(lat1) * math.sin(half_lon) ** 2
    return 2 * _EARTH_M * math.asin(min(1.0, math.sqrt(share)))


def _centred(difference: int, period: int) -> int:
    """A difference modulo a period, in [-period / 2, period / 2)."""
    return (difference + period // 2) % period - period // 2


class PositionSource(ABC):
    """Positions in order of time, handed out as frames pass; used in one thread, but for `counts`.

    Their `timestamp_ns` is on the clock of the frames.
    """

    name: str  # file name or address, for people

    @property
    @abstractmethod
    def counts(self) -> PositionCounts:
        """Counts so far, also of positions left out."""

    @abstractmethod
    def take(self, frame: Frame) -> Sequence[Position]:
        """The positions up to a frame that were not handed out before."""

    @abstractmethod
    def finish(self) -> Sequence[Position]:
        """Positions after the last frame that the fish before it need."""

    def begin(self, *, after_ns: int) -> None:  # noqa: B027, optional
        """The first frame is about to come; `after_ns`: the last capture time of earlier runs."""

    def listen(self, on_notice: Callable[[str], None]) -> None:  # noqa: B027, optional
        """Call `on_notice`, in any thread, with a line for each loss and return of a receiver."""

    def problems(self) -> list[str]:
        """Reasons for having no positions at present, for people; empty if there are positions."""
        return []

    def close(self) -> None:  # noqa: B027, optional
        """Release the file or device. Idempotent."""


def position(fix: Fix, *, timestamp_ns: int, frame_index: int) -> Position:
    """A fix as a message, after the frame of this number."""
    return Position(frame_index=frame_index, timestamp_ns=timestamp_ns, **vars(fix))
