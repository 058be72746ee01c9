"""Where the vessel was: interpolated, nothing across gaps, and stored so."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.messages import Position
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.schema import POSITIONS, read_rows
from stream_dmr.store.trip import (
    KeptPosition,
    PositionThinner,
    VesselTrack,
    kept_of,
    position_values,
    read_positions,
)
from tests.support.final_estimates import FACTS, fish
from tests.support.nmea import START_NS

SECOND = 1_000_000_000


def position(time_s: float | int, *, longitude: float | None = None) -> Position:
    return Position(
        frame_index=0,
        timestamp_ns=round(time_s * SECOND),
        utc_ns=START_NS + round(time_s * SECOND),
        latitude=57.0,
        longitude=time_s * 1e-5 if longitude is None else longitude,
        speed_knots=3.0,
        course_deg=None,
    )


def kept(times_s: Sequence[float], *, keep_s: float = 10.0) -> list[KeptPosition]:
    return list(kept_of(map(position, times_s), keep_s=keep_s, max_gap_s=60.0))


@given(st.lists(st.floats(0, 1000), min_size=2, max_size=80, unique=True), st.floats(0, 1000))
def test_a_straight_way_is_interpolated_exactly_or_not_at_all(times_s: list[float], at_s: float):
    times_s, at_s = sorted({round(time_s, 3) for time_s in times_s}), round(at_s, 3)
    track = VesselTrack(kept(times_s))
    where = track.at(round(at_s * SECOND))
    later = [t for t in times_s if t >= at_s]
    earlier = [t for t in times_s if t <= at_s]
    if where.latitude is None:
        is_between = bool(later and earlier)
        assert not is_between or later[0] - earlier[-1] > 60 - 1e-6 or where.gap_s is not None
        return
    assert later[0] - earlier[-1] <= 60 + 1e-6
    assert where.longitude == pytest.approx(at_s * 1e-5, abs=1e-9)
    assert where.utc_ns is not None
    assert abs(where.utc_ns - START_NS - round(at_s * SECOND)) <= 1


def test_across_a_gap_nothing_is_said_but_the_gap():
    track = VesselTrack(kept([0, 10, 20, 120, 130]))
    assert track.at(70 * SECOND).gap_s == 100
    assert track.at(70 * SECOND).latitude is None
    assert track.at(15 * SECOND).latitude == 57.0
    assert [len(piece) for piece in track.pieces()] == [3, 2]
    assert track.at(-1).gap_s is None
    assert track.at(131 * SECOND).latitude is None


def test_the_short_way_round_the_earth():
    ends = [position(0.0, longitude=179.9), position(10, longitude=-179.9)]
    track = VesselTrack(kept_of(ends, keep_s=0.0, max_gap_s=60.0))
    longitude = track.at(5 * SECOND).longitude
    assert longitude is not None
    assert abs(longitude) == pytest.approx(180.0)


def test_few_are_kept_but_the_first_and_last():
    times_s = [kept.timestamp_ns / SECOND for kept in kept([float(i) for i in range(35)])]
    assert times_s == [0, 10, 20, 30, 34]


def test_a_clock_that_was_set_back_adds_nothing():
    thinner = PositionThinner(keep_s=0.0, max_gap_s=60.0)
    assert [len(thinner.take(position(time_s))) for time_s in (5, 4, 6)] == [1, 0, 1]


def test_each_stored_fish_has_its_place(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    for number, (first_s, last_s) in enumerate([(11, 13), (69, 71), (200, 202)], start=1):
        times = {"first_timestamp_ns": first_s * SECOND, "last_timestamp_ns": last_s * SECOND}
        store.add(fish(number, **times))
    for one in kept([0, 10, 20, 120, 130]):  # the positions after a fish may come later
        store.append(POSITIONS, "x", position_values(one), is_urgent=False)
    store.close()
    assert len(read_rows(store.path, POSITIONS)) == 5
    assert read_positions(store.path) == kept([0, 10, 20, 120, 130])
    first, second, third = read_stored_fish(store.path)
    assert (first.where.latitude, first.utc_ns) == (57.0, START_NS + 12 * SECOND)
    assert (second.where.latitude, second.where.gap_s, second.utc_ns) == (None, 100.0, None)
    assert (third.where.latitude, third.where.gap_s) == (None, None)
