"""Positions of files, handed out as frames pass."""

from pathlib import Path

import numpy as np
import pytest

from stream_dmr.errors import ConfigError, SourceError
from stream_dmr.messages import Frame, Position
from stream_dmr.pipeline.config import parse_config
from stream_dmr.sources.open_source import open_positions
from stream_dmr.sources.position_readers import PositionFile
from stream_dmr.sources.positions import PositionSource
from stream_dmr.sources.sensors_settings import SensorsSettings, utc_ns_of
from tests.support.nmea import START_NS, rmc, straight_way

SECOND = 1_000_000_000
SETTINGS = SensorsSettings(start_utc="2026-11-22T06:00:10Z")


def frame(index: int, timestamp_ns: int) -> Frame:
    image = np.zeros((1, 1, 3), np.uint8)
    return Frame(frame_index=index, timestamp_ns=timestamp_ns, image=image, source="x")


def opened(path: Path, text: str, settings: SensorsSettings = SETTINGS) -> PositionSource:
    path.write_text(text, newline="")
    return open_positions(str(path), settings, is_since_1970=False)


def all_of(source: PositionSource, *seconds: float) -> list[Position]:
    found = [
        position
        for index, time_s in enumerate(seconds, start=1)
        for position in source.take(frame(index, round(time_s * SECOND)))
    ]
    found += source.finish()
    source.close()
    return found


def test_positions_lie_on_the_clock_of_the_frames(tmp_path: Path):
    found = all_of(opened(tmp_path / "way.nmea", straight_way(30)), 0.4, 1.0, 2.9)
    assert [p.timestamp_ns for p in found] == [0, SECOND, 2 * SECOND, 3 * SECOND]
    assert [p.frame_index for p in found] == [1, 2, 3, 3]
    assert [p.utc_ns for p in found] == [START_NS + s * SECOND for s in (10, 11, 12, 13)]


def test_an_offset_moves_them(tmp_path: Path):
    settings = SETTINGS.model_copy(update={"offset_s": -5.0})
    found = all_of(opened(tmp_path / "way.nmea", straight_way(30), settings), 0.0, 1.0)
    assert [p.utc_ns for p in found] == [START_NS + s * SECOND for s in (5, 6, 7)]


def test_a_table_says_the_same(tmp_path: Path):
    rows = [f"2026-11-22T06:00:{s:02d}Z,57.0,{-152 + s * 1e-5:.6f},3.0\n" for s in range(30)]
    table = "time_utc,latitude,longitude,speed_knots\n" + "".join(rows)
    by_table = all_of(opened(tmp_path / "way.csv", table), 0.4, 2.9)
    by_nmea = all_of(opened(tmp_path / "way.nmea", straight_way(30)), 0.4, 2.9)
    assert [p.timestamp_ns for p in by_table] == [p.timestamp_ns for p in by_nmea]
    assert [p.longitude for p in by_table] == pytest.approx([p.longitude for p in by_nmea])


def test_times_that_go_back_are_left_out_and_a_wrong_first_date_too(tmp_path: Path):
    seconds = [53 * 7 * 86_400, 9, 10, 11, 10, 12]
    lines = "".join(rmc(START_NS + s * SECOND, 57.0, -152.0) for s in seconds)
    source = opened(tmp_path / "way.nmea", lines)
    found = all_of(source, 0.0, 5.0)
    times = [p.utc_ns for p in found]
    assert times == sorted(set(times))
    assert set(times) <= {START_NS + s * SECOND for s in seconds[1:]}
    assert source.counts.jumps >= 2
    assert source.counts.sentences == len(seconds)
    assert source.counts.positions + source.counts.jumps == len(seconds)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("empty.nmea", "", "it is empty"),
        ("words.txt", "no positions\n", "1 unreadable"),
        ("table.csv", "time,lat,lon\n", "expected the columns time_utc,latitude,longitude"),
        ("table.csv", "time_utc,latitude,longitude\n2026-11-22,95,10\n", "1 unreadable"),
    ],
)
def test_a_file_without_positions_is_refused(tmp_path: Path, name: str, text: str, expected: str):
    with pytest.raises(SourceError, match=expected):
        opened(tmp_path / name, text)


def test_a_video_needs_its_start_and_a_file(tmp_path: Path):
    with pytest.raises(SourceError, match="add it to the file of --config"):
        opened(tmp_path / "way.nmea", straight_way(3), SensorsSettings())
    with pytest.raises(SourceError, match="for cameras"):
        open_positions("tcp://127.0.0.1:10110", SETTINGS, is_since_1970=False)
    with pytest.raises(SourceError, match="expected a file"):
        PositionFile(tmp_path / "none", SETTINGS, is_since_1970=False)


def test_times_of_the_settings():
    assert utc_ns_of("2026-11-22T06:00:00Z") == START_NS
    assert utc_ns_of("2026-11-22T07:00:00.5+01:00") == START_NS + SECOND // 2
    with pytest.raises(ConfigError, match=r"\[sensors\]: 'start_utc' expected a time in ISO 8601"):
        parse_config('[sensors]\nstart_utc = "yesterday"', where="config.toml")


@pytest.mark.parametrize("name", ["way.nmea", "way.csv"])
@pytest.mark.parametrize("num_good", [0, 30])
def test_a_line_without_end_is_refused(tmp_path: Path, name: str, num_good: int):
    good = straight_way(num_good)
    if name.endswith(".csv"):
        good = "time_utc,latitude,longitude\n" + "2026-11-22T06:00:11Z,57.0,-152.0\n" * num_good
    with pytest.raises(SourceError, match="lines of 4096 bytes at most, got a longer one"):
        all_of(opened(tmp_path / name, good + "$GPRMC," * 10_000), 0.4, 99.0)
