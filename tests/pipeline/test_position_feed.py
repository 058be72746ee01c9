"""Positions on their way into a run."""

from pathlib import Path

from stream_dmr.messages import Position
from stream_dmr.pipeline.measure_source import PositionFeed
from stream_dmr.sources.position_readers import PositionFile
from stream_dmr.sources.sensors_settings import SensorsSettings
from tests.sources.test_position_file import frame
from tests.support.nmea import straight_way


def fed(path: Path, start_utc: str, text: str) -> tuple[list[Position], str]:
    path.write_text(text)
    source = PositionFile(path, SensorsSettings(start_utc=start_utc), is_since_1970=False)
    written: list[Position] = []
    feed = PositionFeed(source, written.append)
    for index in range(3):
        feed.take(frame(index + 1, index * 1_000_000_000))
    said = feed.finish()
    source.close()
    return written, said


def test_positions_of_the_frames_and_the_one_after(tmp_path: Path):
    written, said = fed(tmp_path / "way.nmea", "2026-11-22T06:00:00Z", straight_way(9))
    assert [position.frame_index for position in written] == [1, 2, 3, 3]
    assert said == ""


def test_positions_of_another_day_are_said(tmp_path: Path):
    written, said = fed(tmp_path / "way.nmea", "2026-11-25T06:00:00Z", straight_way(9))
    assert written == []
    assert "none is of the time of the frames" in said


def test_what_was_left_out_is_said(tmp_path: Path):
    text = "$GPRMC,1\n" + straight_way(9)
    assert "1 unreadable" in fed(tmp_path / "way.nmea", "2026-11-22T06:00:00Z", text)[1]
