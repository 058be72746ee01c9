"""Sentences of NMEA 0183, made without the library that reads them."""

from datetime import UTC, datetime
from functools import reduce

START_NS = 1_795_327_200_000_000_000  # 2026-11-22T06:00:00Z


def sentence(content: str) -> str:
    """With $, checksum and end of line."""
    checksum = reduce(lambda total, byte: total ^ byte, content.encode(), 0)
    return f"${content}*{checksum:02X}\r\n"


def rmc(
    utc_ns: int,
    latitude: float,
    longitude: float,
    *,
    knots: float = 3.0,
    course: float = 90.0,
    status: str = "A",
) -> str:
    """A measured position with its time and date."""
    moment = _moment(utc_ns)
    place = f"{_degrees(latitude, 2, 'NS')},{_degrees(longitude, 3, 'EW')}"
    return sentence(
        f"GPRMC,{moment:%H%M%S}.{utc_ns // 10_000_000 % 100:02d},{status},{place},"
        f"{knots:.2f},{course:.1f},{moment:%d%m%y},,,A"
    )


def gga(utc_ns: int, latitude: float, longitude: float, *, quality: int = 1) -> str:
    """The same place without a date."""
    place = f"{_degrees(latitude, 2, 'NS')},{_degrees(longitude, 3, 'EW')}"
    return sentence(f"GPGGA,{_moment(utc_ns):%H%M%S}.00,{place},{quality},08,0.9,10.0,M,40.0,M,,")


def straight_way(seconds: int, *, latitude: float = 57.0, longitude: float = -152.0) -> str:
    """A position a second, to the east."""
    lines = [
        rmc(START_NS + i * 1_000_000_000, latitude, longitude + i * 1e-5) for i in range(seconds)
    ]
    return "".join(lines)


def _moment(utc_ns: int) -> datetime:
    return datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC)


def _degrees(value: float, digits: int, letters: str) -> str:
    whole, minutes = divmod(round(abs(value) * 60 * 1e6), 60 * 10**6)
    return f"{whole:0{digits}d}{minutes / 1e6:09.6f},{letters[value < 0]}"
