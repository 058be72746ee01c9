"""Sentences of receivers: what they say, and what is refused."""

from contextlib import suppress
from datetime import date

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.sources.positions import WrongChecksumError, read_sentence
from tests.support.nmea import START_NS, gga, rmc, sentence


def test_a_known_sentence():
    line = b"$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n"
    read = read_sentence(line)
    assert read is not None
    assert (read.day, read.time_of_day_ns) == (date(1994, 3, 23), 45_319 * 10**9)
    assert (read.latitude, read.longitude) == (pytest.approx(48.1173), pytest.approx(11.516667))
    assert (read.speed_knots, read.course_deg, read.is_fix) == (22.4, 84.4, True)


@given(st.floats(-90, 90), st.floats(-180, 180), st.booleans())
def test_places_are_read_as_they_were_written(latitude: float, longitude: float, is_rmc: bool):
    line = (rmc if is_rmc else gga)(START_NS, latitude, longitude)
    read = read_sentence(line.encode())
    assert read is not None
    assert read.is_fix
    assert read.latitude == pytest.approx(latitude, abs=1e-7)
    assert read.longitude == pytest.approx(longitude, abs=1e-7)


@given(st.integers(0, 60), st.integers(1, 255))
def test_a_changed_byte_is_never_a_position_elsewhere(index: int, change: int):
    line = bytearray(rmc(START_NS, 57.0, -152.0).encode())
    line[index] ^= change
    try:
        read = read_sentence(bytes(line))
    except (WrongChecksumError, ValueError):
        return
    assert read is None or read == read_sentence(rmc(START_NS, 57.0, -152.0).encode())


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(data: bytes):
    with suppress(WrongChecksumError, ValueError):
        assert read_sentence(data) is None


@pytest.mark.parametrize("line", [b"", b"$", b"$GPRMC", b"$GPRMC,123519,A,48", b"x" * 500])
def test_what_is_no_sentence_is_refused(line: bytes):
    with pytest.raises(ValueError):  # noqa: PT011, each with its own words
        read_sentence(line)


def test_a_receiver_that_says_it_has_none_gives_none():
    for line in (
        rmc(START_NS, 57.0, -152.0, status="V"),
        gga(START_NS, 57.0, -152.0, quality=0),
        gga(START_NS, 57.0, -152.0, quality=8),  # simulated
        sentence("GPRMC,,V,,,,,,,,,,N"),
    ):
        read = read_sentence(line.encode())
        assert read is not None
        assert not read.is_fix


def test_other_sentences_are_no_positions():
    assert read_sentence(sentence("HEHDT,123.4,T").encode()) is None
    assert read_sentence(b"!AIVDM,1,1,,A,14eG;o@034o8sd<L9i:a;WF>062D,0*7D") is None
