"""Hauls: what events make of them, and the effort that counts are divided by."""

import time
from collections import Counter
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import UserError
from stream_dmr.export.agency_tables import haul_row
from stream_dmr.messages import LengthEstimate, Position
from stream_dmr.pipeline.config import HaulsSettings
from stream_dmr.pipeline.haul_log import HaulLog, write_haul
from stream_dmr.store.effort import read_effort
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.schema import HAULS, NAME, WATCHED, read_rows
from stream_dmr.store.trip import haul_at, haul_values, hauls_of
from tests.support.final_estimates import FACTS, fish

SECOND = 1_000_000_000
MINUTE = 60 * SECOND


def at(track_id: int, time_s: float) -> LengthEstimate:
    time_ns = round(time_s * SECOND)
    return fish(track_id, first_timestamp_ns=time_ns - SECOND, last_timestamp_ns=time_ns + SECOND)


@given(st.lists(st.tuples(st.sampled_from(["start", "end"]), st.integers(0, 50)), max_size=12))
def test_hauls_never_overlap(events: list[tuple[str, int]]):
    rows = [haul_values(what, str(i), time, "x") for i, (what, time) in enumerate(events)]
    hauls = hauls_of(rows)
    assert len(hauls) == sum(what == "start" for what, _ in events)
    for before, after in pairwise(hauls):
        assert before.ended_ns is not None
        assert before.began_ns <= before.ended_ns <= after.began_ns
    for time_ns in range(51):
        names = [haul.name for haul in hauls if haul.includes(time_ns)]
        assert [haul_at(hauls, time_ns)] == (names or [""])


def test_a_fish_belongs_to_the_haul_of_its_middle():
    rows = [haul_values(w, n, t, "x") for w, n, t in [("start", "A", 10), ("end", "A", 20)]]
    assert [haul_at(hauls_of(rows), time) for time in (9, 10, 19, 20)] == ["", "A", "A", ""]


def test_a_run_that_is_told_of_hauls(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    log = HaulLog(store, HaulsSettings(), frames_lost=lambda: 0)
    with pytest.raises(UserError, match="begin one first"):
        log.mark("end", said_by="Ada")
    told = {60: ("start", "north"), 240: ("end", ""), 300: ("start", "")}
    names: list[str] = []
    for second in range(0, 601, 5):
        log.take_frame(second * SECOND)
        if second in told:
            names.append(log.mark(*told[second], said_by="Ada"))
    current = log.current()
    log.finish()
    watched = read_rows(store.path, WATCHED)  # as the digest of the last day reads it
    assert sum(row["last_ns"] - row["first_ns"] for row in watched) == 600 * SECOND
    for track_id, time_s in enumerate((30, 120, 200, 400), start=1):
        store.add(at(track_id, time_s))
    store.close()
    assert names == ["north", "north", "1"]
    assert current is not None
    assert current.name == "1"
    found = read_stored_fish(store.path)
    assert [one.haul for one in found] == ["", "north", "north", "1"]
    efforts = {one.haul: one for one in read_effort(store.path, found)}
    assert efforts["north"].hours_watched == pytest.approx(180 / 3600)
    assert efforts["1"].hours_watched == pytest.approx(300 / 3600)
    assert efforts[""].hours_watched == pytest.approx(120 / 3600)
    assert [efforts[name].num_fish for name in ("north", "1", "")] == [2, 1, 1]
    assert efforts["north"].share_measured == 1.0
    assert efforts[""].share_measured == 1.0


def test_a_haul_that_is_begun_again_has_only_its_own_times(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    log = HaulLog(store, HaulsSettings())
    told = {100: ("start", "7"), 200: ("start", "8"), 400: ("start", "7"), 500: ("end", "")}
    for second in range(0, 601, 5):
        log.take_frame(second * SECOND)
        if second in told:
            log.mark(*told[second], said_by="Ada")
    log.finish()
    store.close()
    efforts = {one.haul: one for one in read_effort(store.path, [])}
    hours = {name: 3600 * effort.hours_watched for name, effort in efforts.items()}
    assert hours == pytest.approx({"7": 200, "8": 200, "": 200})
    assert (efforts["7"].began_ns, efforts["7"].ended_ns) == (100 * SECOND, 500 * SECOND)


def test_the_hours_of_many_hauls_are_those_counted_minute_by_minute(tmp_path: Path):
    rng, store = np.random.default_rng(3), LengthStore(tmp_path, FACTS)
    for number, minute in enumerate(rng.integers(0, 500, 40).tolist()):
        what = "start" if number % 3 else "end"
        store.append(HAULS, "x", haul_values(what, str(number % 7), minute * MINUTE, "Ada"))
    counted = Counter[str]()
    hauls = hauls_of(read_rows(store.path, HAULS))
    for first in rng.integers(0, 500, 60).tolist():
        last = first + int(rng.integers(0, 60))
        span = {"first_ns": first * MINUTE, "last_ns": last * MINUTE, "frames": 1, "frames_lost": 0}
        store.append(WATCHED, "x", span)
        for minute in range(first, last):
            within = (one.name for one in hauls if one.includes(minute * MINUTE))
            counted[next(within, "")] += 1
    store.close()
    hours = {one.haul: 60 * one.hours_watched for one in read_effort(store.path, [])}
    assert hours == pytest.approx({name: counted[name] for name in hours})
    assert sum(hours.values()) == pytest.approx(counted.total())


def test_a_haul_that_a_command_began_after_the_last_frame_ends_by_the_button(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    log = HaulLog(store, HaulsSettings())
    log.take_frame(100 * SECOND)
    write_haul(tmp_path, "start", name="7", at="110", said_by="Ada")
    log.mark("end", said_by="Bo")
    assert log.current() is None
    store.close()


def test_fish_are_counted_by_fate_with_each_haul(tmp_path: Path):
    store = LengthStore(tmp_path, replace(FACTS, haul="7"))
    fates = ["landed", "unknown", "cut off", "landed", None]
    for track_id, fate in enumerate(fates, start=1):
        store.add(replace(at(track_id, 10.0 * track_id), fate=fate))
    store.close()
    found = read_stored_fish(store.path)
    (effort,) = read_effort(store.path, found)
    row = haul_row(effort, utc_zero_ns=None)
    assert [row[f"num_{zone}"] for zone in ("landed", "dropped", "cut_off")] == ["2", "0", "1"]
    (effort,) = read_effort(store.path, found[4:])
    row = haul_row(effort, utc_zero_ns=None)
    assert [row[f"num_{zone}"] for zone in ("landed", "dropped", "cut_off")] == ["", "", ""]


def test_frames_that_were_lost_lower_the_share(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    lost = iter(range(0, 200, 1))
    log = HaulLog(store, HaulsSettings(), frames_lost=lambda: next(lost))
    for second in range(100):
        log.take_frame(second * SECOND)
    log.finish()
    store.close()
    (effort,) = read_effort(store.path, [])
    assert effort.share_measured == pytest.approx(100 / 199, abs=0.01)


def test_a_pause_of_the_camera_is_not_watched(tmp_path: Path):
    store = LengthStore(tmp_path, replace(FACTS, haul="7"))
    log = HaulLog(store, HaulsSettings())
    for second in (*range(0, 61), *range(1000, 1061)):
        log.take_frame(second * SECOND)
    log.finish()
    store.close()
    (effort,) = read_effort(store.path, [])
    assert effort.hours_watched == pytest.approx(120 / 3600)
    row = haul_row(effort, utc_zero_ns=1_795_327_200 * SECOND)
    span = (row["began_utc"], row["ended_utc"])
    assert span == ("2026-11-22T06:00:00.000Z", "2026-11-22T06:17:40.000Z")


def test_hauls_by_rule(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    log = HaulLog(store, HaulsSettings(pause_min=5.0, end_speed_knots=6.0))
    fish_at = [100.0, 300.0, 1000.0, 1100.0, 2000.0]
    number = 0
    for second in range(0, 2400, 10):
        log.take_frame(second * SECOND)
        knots = 9.0 if second >= 2100 else 2.0
        log.take_position(_position(second, knots))
        while number < len(fish_at) and fish_at[number] + 1 <= second:
            number += 1
            one = at(number, fish_at[number - 1])
            log.take_fish(one)
            store.add(one)
        log.frame_done()
    log.finish()
    store.close()
    assert [one.haul for one in read_stored_fish(store.path)] == ["1", "1", "2", "2", "3"]


def test_a_rule_does_not_end_a_haul_that_a_command_began_during_its_own(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    log = HaulLog(store, HaulsSettings(pause_min=5.0))
    for second in range(0, 600, 10):
        log.take_frame(second * SECOND)
        if second in (100, 200):
            log.take_fish(at(second, second - 10.0))
        if second == 160:
            write_haul(tmp_path, "start", name="north", at="150", said_by="Ada")
        log.frame_done()
    current = log.current()
    log.finish()
    store.close()
    assert current == log.current()
    assert current is not None
    assert current.name == "north"


def test_a_rule_begins_no_haul_before_the_end_of_one_that_people_ended(tmp_path: Path):
    """A fish in view at that end belongs to A or to the haul of the rule, which comes after it."""
    store = LengthStore(tmp_path, FACTS)
    log = HaulLog(store, HaulsSettings(pause_min=0.1))
    for second in range(0, 200, 10):
        log.take_frame(second * SECOND)
        if second in (0, 60):
            log.mark("start" if second == 0 else "end", "A", said_by="Ada")
        if second in (70, 100):  # the end of the first came to light after that of the haul
            last_ns = (58 if second == 70 else 90) * SECOND
            log.take_fish(fish(second, first_timestamp_ns=50 * SECOND, last_timestamp_ns=last_ns))
        log.frame_done()
    first, second = log.hauls()
    store.close()
    assert (first.name, first.ended_ns) == ("A", 60 * SECOND)
    assert (second.name, second.began_ns, second.ended_ns) == ("1", 60 * SECOND, 90 * SECOND + 1)


def test_a_command_without_a_time_means_the_frames_that_come_now(tmp_path: Path):
    """Whatever the clock was set to after a camera's run began."""
    times = [time.time_ns() + hours * 3600 * SECOND for hours in (-2, 0, 2)]
    for began_ns in times:
        folder = tmp_path / str(began_ns)
        folder.mkdir()
        with closing(LengthStore(folder, replace(FACTS, utc_zero_ns=0))) as store:
            store.frame_done()
            store.frame_passed(frame_index=1, timestamp_ns=began_ns)
            write_haul(folder, "start", name="7", at=None, said_by="Ada")
        with closing(LengthStore(folder, replace(FACTS, utc_zero_ns=0))):  # no frame came yet
            write_haul(folder, "start", name="8", at=None, said_by="Ada")
        first, second = hauls_of(read_rows(folder / NAME, HAULS))
        assert 0 <= first.began_ns - began_ns <= 5 * SECOND
        assert abs(second.began_ns - max(times[1], began_ns)) <= 5 * SECOND


def test_a_rule_waits_for_the_fish_of_frames_before_a_pause(tmp_path: Path):
    """Two fish in view together, and the camera's next frame an hour later is there before them."""
    store = LengthStore(tmp_path, FACTS)
    log = HaulLog(store, HaulsSettings(pause_min=5.0))
    first, second = (fish(n, first_timestamp_ns=10 - n, last_timestamp_ns=20 + n) for n in (1, 2))
    for time_ns in (10, 20, 60 * MINUTE):
        log.take_frame(time_ns)
    log.take_fish(replace(first, is_final=False))
    log.take_fish(replace(second, is_final=False))
    log.frame_done()
    log.take_fish(first)
    log.frame_done()
    log.take_fish(second)
    log.frame_done()
    (haul,) = log.hauls()
    log.finish()
    store.close()
    assert (haul.began_ns, haul.ended_ns) == (8, 23)


def test_a_rule_goes_on_after_a_crash(tmp_path: Path):
    """The haul that it began and never ended ends with the last fish, unless fish come soon."""
    for number, time_s in enumerate((100.0, 200.0, 1000.0), start=1):
        store = LengthStore(tmp_path, FACTS)
        log = HaulLog(store, HaulsSettings(pause_min=5.0))
        for second in range(round(time_s) - 2, round(time_s) + 2):
            log.take_frame(second * SECOND)
            log.frame_done()
        log.take_fish(at(number, time_s))
        store.add(at(number, time_s))
        store.close()  # without log.finish()
    first, second = hauls_of(read_rows(tmp_path / NAME, HAULS))
    assert (first.began_ns, first.ended_ns) == (99 * SECOND, 201 * SECOND + 1)
    assert (second.name, second.began_ns, second.ended_ns) == ("2", 999 * SECOND, None)


def _position(second: int, knots: float) -> Position:
    return Position(
        frame_index=1,
        timestamp_ns=second * SECOND,
        utc_ns=None,
        latitude=0.0,
        longitude=0.0,
        speed_knots=knots,
        course_deg=None,
    )


def test_hauls_of_a_folder_afterwards(tmp_path: Path):
    store = LengthStore(tmp_path, FACTS)
    for track_id, time_s in enumerate((10, 20, 30), start=1):
        store.add(at(track_id, time_s))
    store.close()
    with pytest.raises(UserError, match="say when, with --at"):
        write_haul(tmp_path, "start", name="", at=None, said_by="Ada")
    with pytest.raises(UserError, match="time of day"):
        write_haul(tmp_path, "start", name="", at="2026-11-22T06:00:00Z", said_by="Ada")
    write_haul(tmp_path, "start", name="A", at="15", said_by="Ada")
    assert write_haul(tmp_path, "end", name="", at="25.5", said_by="Ada") == "A"
    assert [one.haul for one in read_stored_fish(store.path)] == ["", "A", ""]
    for nothing_to_end in ("14", "26"):
        with pytest.raises(UserError, match="expected a haul that goes on"):
            write_haul(tmp_path, "end", name="", at=nothing_to_end, said_by="Ada")
    for no_time in ("inf", "1e30", "nan"):
        with pytest.raises(UserError):
            write_haul(tmp_path, "start", name="", at=no_time, said_by="Ada")
    write_haul(tmp_path, "start", name="B", at="40", said_by="Ada")
    assert write_haul(tmp_path, "end", name="", at="20", said_by="Ada") == "A"
