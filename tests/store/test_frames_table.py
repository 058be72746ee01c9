"""frames.csv: one row per fish and frame, with the final verdict, on the disk as it comes."""

import csv
from dataclasses import replace
from pathlib import Path

import pytest

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate, LocalizedFish, Message
from stream_dmr.recording.record import make_record
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.store.run_tables import FramesTable
from tests.support.recorded_run import run
from tests.support.small_disk import file_size_limit

HEADER = (
    "frame_index,timestamp_ns,track_id,head_u,head_v,center_u,center_v,tail_u,tail_v,"
    "head_x_mm,head_y_mm,head_z_mm,center_x_mm,center_y_mm,center_z_mm,"
    "tail_x_mm,tail_y_mm,tail_z_mm,bending_ratio,length_mm,length_std_mm,iou,accepted,reason"
)


def write_all(table: FramesTable, messages: list[Message]) -> None:
    for message in messages:
        table.write(make_record(message, RecordingSettings()))


def write(out: Path, messages: list[Message]) -> list[dict[str, str]]:
    table = FramesTable(out)
    write_all(table, messages)
    table.close()
    table.close()
    return read(out / "frames.csv")


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    return list(run(12))


@pytest.fixture(scope="module")
def fish(messages: list[Message]) -> list[LocalizedFish]:
    return [message for message in messages if isinstance(message, LocalizedFish)]


def test_an_empty_clip_gives_the_header(tmp_path: Path):
    table = FramesTable(tmp_path)
    assert (tmp_path / "frames.csv").read_text() == HEADER + "\n"
    table.close()
    assert (tmp_path / "frames.csv").read_text() == HEADER + "\n"


def test_each_fish_of_each_frame_has_a_row(
    tmp_path: Path, messages: list[Message], fish: list[LocalizedFish]
):
    rows = write(tmp_path, messages)
    for row, one in zip(rows, fish, strict=True):
        assert one.keypoints_px is not None
        assert one.keypoints_mm is not None
        assert (int(row["frame_index"]), int(row["track_id"])) == (one.frame_index, one.track_id)
        assert int(row["timestamp_ns"]) == one.timestamp_ns
        assert float(row["tail_u"]) == pytest.approx(one.keypoints_px[2, 0], abs=1e-6)
        assert float(row["center_v"]) == pytest.approx(one.keypoints_px[1, 1], abs=1e-6)
        assert float(row["head_z_mm"]) == pytest.approx(one.keypoints_mm[0, 2], abs=1e-6)
        assert float(row["tail_x_mm"]) == pytest.approx(one.keypoints_mm[2, 0], abs=1e-6)
        assert float(row["length_mm"]) == pytest.approx(one.length_mm, abs=1e-6)


def test_the_verdict_is_that_of_the_estimate(
    tmp_path: Path, messages: list[Message], fish: list[LocalizedFish]
):
    estimate = next(m for m in messages if isinstance(m, LengthEstimate))
    gated = replace(estimate, is_frame_used=False, frame_reason='an outlier, "far" off')
    (row,) = write(tmp_path, [fish[0], gated])
    assert fish[0].accepted
    assert (row["accepted"], row["reason"]) == ("false", 'an outlier, "far" off')


def test_a_fish_without_an_estimate_is_written_at_the_end(
    tmp_path: Path, fish: list[LocalizedFish]
):
    assert [row["accepted"] for row in write(tmp_path, [fish[0]])] == ["true"]


def test_rows_are_on_disk_as_they_come(
    tmp_path: Path, messages: list[Message], fish: list[LocalizedFish]
):
    table = FramesTable(tmp_path)
    write_all(table, messages)
    assert len(read(tmp_path / "frames.csv")) == len(fish)
    table.close()


def test_missing_values_are_blank(tmp_path: Path):
    row = write(tmp_path, list(run(2, num_fish=1, calibrated=False)))[0]
    assert row["length_mm"] == row["head_x_mm"] == row["tail_z_mm"] == ""
    assert row["bending_ratio"] != ""
    assert row["head_u"] != ""


def test_a_full_disk_is_refused_in_one_line_and_leaves_whole_rows(
    tmp_path: Path, messages: list[Message], fish: list[LocalizedFish]
):
    table = FramesTable(tmp_path)
    with file_size_limit(1000):
        with pytest.raises(OutputError, match=r"frames\.csv.*room"):
            write_all(table, messages)
        table.close()
    assert (tmp_path / "frames.csv").read_text().endswith("\n")
    assert 0 < len(read(tmp_path / "frames.csv")) < len(fish)


def test_a_table_that_was_deleted_is_refused_whatever_comes(
    tmp_path: Path, messages: list[Message]
):
    """Else the next record that is no row would pass for one that was written."""
    table = FramesTable(tmp_path, is_endless=True)
    (tmp_path / "frames.csv").unlink()
    for message in messages:
        with pytest.raises(OutputError, match="another file or none has its name now"):
            write_all(table, [message])
    table.close()
