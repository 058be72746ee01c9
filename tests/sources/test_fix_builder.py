"""Dates, jumps and roll-overs: what is left out is counted, and nothing is invented."""

from stream_dmr.sources.positions import Fix, FixBuilder, JumpGate, distance_m
from stream_dmr.sources.sensors_settings import SensorsSettings
from tests.support.nmea import START_NS, gga, rmc, sentence

SECOND = 1_000_000_000
WEEK = 7 * 86_400 * SECOND


def builder(now_ns: int | None = None) -> FixBuilder:
    return FixBuilder(SensorsSettings(), now_ns=lambda: now_ns)


def test_each_line_is_counted_once():
    made = builder()
    lines = [
        rmc(START_NS, 57.0, -152.0),
        rmc(START_NS + SECOND, 57.0, -152.0).replace("57", "58"),
        rmc(START_NS + 2 * SECOND, 57.0, -152.0, status="V"),
        "$GPRMC,12",
        rmc(START_NS + 4 * SECOND, 58.0, -152.0),  # 60 miles in four seconds
        rmc(START_NS + 5 * SECOND, 57.0, -152.0),
        sentence("HEHDT,123.4,T"),
        "\r\n",
    ]
    fixes = [made.take(line.encode()) for line in lines]
    assert [fix is not None for fix in fixes] == [
        True,
        False,
        False,
        False,
        False,
        True,
        *[False] * 2,
    ]
    counts = made.counts
    assert (counts.sentences, counts.positions, counts.wrong_checksum) == (7, 2, 1)
    assert (counts.without_fix, counts.unreadable, counts.jumps) == (1, 1, 1)
    assert "1 with a wrong checksum" in counts.left_out()


def test_a_place_without_date_takes_it_from_another_clock_or_is_left_out():
    line = gga(START_NS, 57.0, -152.0).encode()
    made = builder()
    assert made.take(line) is None
    assert made.counts.without_date == 1
    for hours in (-11, 0, 11):
        fix = builder(START_NS + hours * 3600 * SECOND).take(line)
        assert fix is not None
        assert fix.utc_ns == START_NS


def test_a_receiver_that_sends_both_kinds_gives_each_moment_once():
    made = builder()
    lines = [kind(START_NS + i * SECOND, 57.0, -152.0) for i in range(5) for kind in (gga, rmc)]
    times = [fix.utc_ns for line in lines if (fix := made.take(line.encode())) is not None]
    assert times == [START_NS + i * SECOND for i in range(5)]


def test_a_date_off_by_1024_weeks_is_put_right_by_another_clock_alone():
    line = rmc(START_NS - 1024 * WEEK, 57.0, -152.0).encode()
    made = builder(START_NS + 3600 * SECOND)
    fix = made.take(line)
    assert fix is not None
    assert (fix.utc_ns, made.counts.roll_overs) == (START_NS, 1)
    for other_ns in (None, START_NS + 3 * WEEK):  # no other clock, or one that does not agree
        fix = (made := builder(other_ns)).take(line)
        assert fix is not None
        assert (fix.utc_ns, made.counts.roll_overs) == (START_NS - 1024 * WEEK, 0)


def test_positions_after_a_jump_count_once_they_agree():
    gate = JumpGate(60.0)
    there = [Fix(utc_ns=None, latitude=10.0, longitude=i * 1e-5) for i in range(5)]
    assert gate.lets_pass(Fix(utc_ns=None, latitude=57.0, longitude=0.0), 0)
    passed = [gate.lets_pass(fix, (i + 1) * SECOND) for i, fix in enumerate(there)]
    assert passed == [False, False, True, True, True]


def test_a_time_that_jumps_is_left_out_of_a_receiver_too_until_others_agree():
    made = builder(START_NS)
    ahead_s = [0, 0, 86_400, 0, -7200, 0, *[600] * 4]
    passed = []
    for i, ahead in enumerate(ahead_s):
        line = rmc(START_NS + (i + ahead) * SECOND, 57.0, -152.0).encode()
        passed.append(made.take(line, arrival_ns=i * SECOND) is not None)
    assert passed == [True, True, False, True, False, True, False, False, True, True]
    assert made.counts.jumps == 4


def test_distance_of_a_degree_along_a_meridian():
    one, other = (Fix(utc_ns=0, latitude=lat, longitude=7.0) for lat in (0.0, 1.0))
    assert abs(distance_m(one, other) - 111_195) < 1
    across = [Fix(utc_ns=0, latitude=0.0, longitude=lon) for lon in (179.5, -179.5)]
    assert abs(distance_m(*across) - 111_195) < 1
