"""Reads the two NMEA 0183 sentences that give a position: RMC and GGA, of any talker."""

from dataclasses import dataclass
from datetime import date, time
from typing import Any

from pynmeagps import NMEAReader
from pynmeagps.exceptions import NMEAMessageError, NMEAParseError, NMEATypeError
from pynmeagps.nmeahelpers import calc_checksum, get_parts

from stream_dmr.errors import UserError

_KINDS = ("RMC", "GGA")
_MEASURED_MODES = ("", "A", "D", "F", "P", "R")  # not estimated, typed in, or simulated
_MEASURED_QUALITIES = (1, 2, 3, 4, 5)  # of GGA, likewise
_MAX_BYTES = 120  # of a sentence; the standard has 82


class WrongChecksumError(UserError):
    """A sentence whose checksum is not that of its text."""


@dataclass(frozen=True, kw_only=True)
class PositionSentence:
    """One RMC or GGA; None where it leaves something empty."""

    kind: str  # "RMC" or "GGA"
    day: date | None  # UTC; a GGA has none
    time_of_day_ns: int | None  # UTC
    latitude: float | None  # degrees, WGS 84, north positive
    longitude: float | None  # east positive
    speed_knots: float | None = None  # over ground
    course_deg: float | None = None  # over ground, clockwise from true north
    is_fix: bool  # does the receiver say that it measured this position?


def read_sentence(line: bytes) -> PositionSentence | None:
    """The position in a line; None for sentences of other kinds.

    Raises WrongChecksumError, and ValueError where it is no sentence.
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
    return PositionSentence(
        kind=kind,
        day=_of_type(getattr(message, "date", None), date),
        time_of_day_ns=_time_of_day_ns(message.time),
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
    """A field as a number; an empty one is a text for pynmeagps."""
    return float(value) if isinstance(value, int | float) else None


def _of_type(value: object, kind: type[date]) -> date | None:
    return value if isinstance(value, kind) else None


def _time_of_day_ns(value: object) -> int | None:
    if not isinstance(value, time):
        return None
    seconds = (value.hour * 60 + value.minute) * 60 + value.second
    return seconds * 1_000_000_000 + value.microsecond * 1000
