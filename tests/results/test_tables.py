import csv
import resource
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate, LocalizedFish, Message
from stream_dmr.recording.messages.record import make_record
from stream_dmr.recording.settings import RecordingSettings
from stream_dmr.results.tables import Tables, seconds
from tests.support.recorded_run import run

LENGTHS_HEADER = (
    "track_id,length_mm,length_std_mm,ci95_low_mm,ci95_high_mm,frames_seen,frames_used,"
    "first_frame,last_frame,first_time,last_time,status"
)
FRAMES_HEADER = (
    "frame_index,timestamp_ns,track_id,head_u,head_v,center_u,center_v,tail_u,tail_v,"
    "head_x_mm,head_y_mm,head_z_mm,center_x_mm,center_y_mm,center_z_mm,"
    "tail_x_mm,tail_y_mm,tail_z_mm,bending_ratio,length_mm,length_std_mm,iou,accepted,reason"
)


def write_all(tables: Tables, messages: list[Message]) -> None:
    for message in messages:
        tables.write(make_record(message, RecordingSettings()))


def write(out: Path, messages: list[Message]) -> tuple[list[dict], list[dict]]:
    tables = Tables(out)
    write_all(tables, messages)
    tables.close()
    tables.close()
    return read(out / "lengths.csv"), read(out / "frames.csv")


def read(path: Path) -> list[dict]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    return list(run(12))


def test_an_empty_clip_gives_headers_from_the_start(tmp_path: Path):
    tables = Tables(tmp_path)
    assert (tmp_path / "lengths.csv").read_text() == LENGTHS_HEADER + "\n"
    assert (tmp_path / "frames.csv").read_text() == FRAMES_HEADER + "\n"
    tables.close()
    assert (tmp_path / "lengths.csv").read_text() == LENGTHS_HEADER + "\n"


def test_a_row_a_fish_and_a_row_a_fish_and_frame(tmp_path: Path, messages: list[Message]):
    lengths, frames = write(tmp_path, messages)
    finals = [m for m in messages if isinstance(m, LengthEstimate) and m.is_final]
    fish = [m for m in messages if isinstance(m, LocalizedFish)]
    assert [int(row["track_id"]) for row in lengths] == [m.track_id for m in finals]
    assert [(int(row["frame_index"]), int(row["track_id"])) for row in frames] == [
        (m.frame_index, m.track_id) for m in fish
    ]
    for row, final in zip(lengths, finals, strict=True):
        assert final.ci95_mm is not None
        assert float(row["length_mm"]) == pytest.approx(final.length_mm, abs=1e-6)
        assert float(row["ci95_low_mm"]) == pytest.approx(final.ci95_mm[0], abs=1e-6)
        assert float(row["ci95_high_mm"]) == pytest.approx(final.ci95_mm[1], abs=1e-6)
        assert (int(row["frames_seen"]), int(row["frames_used"])) == (
            final.frames_seen,
            final.frames_used,
        )
        assert row["status"] == "measured"
    for row, one in zip(frames, fish, strict=True):
        assert one.keypoints_px is not None
        assert one.keypoints_mm is not None
        assert float(row["tail_u"]) == pytest.approx(one.keypoints_px[2, 0], abs=1e-6)
        assert float(row["center_v"]) == pytest.approx(one.keypoints_px[1, 1], abs=1e-6)
        assert float(row["head_z_mm"]) == pytest.approx(one.keypoints_mm[0, 2], abs=1e-6)
        assert float(row["tail_x_mm"]) == pytest.approx(one.keypoints_mm[2, 0], abs=1e-6)
        assert float(row["length_mm"]) == pytest.approx(one.length_mm, abs=1e-6)
        assert int(row["timestamp_ns"]) == one.timestamp_ns


def test_the_verdict_is_the_estimate_s_not_the_localization_s(
    tmp_path: Path, messages: list[Message]
):
    fish = next(m for m in messages if isinstance(m, LocalizedFish))
    estimate = next(m for m in messages if isinstance(m, LengthEstimate))
    gated = replace(estimate, is_frame_used=False, frame_reason='an outlier, "far" off')
    _, frames = write(tmp_path, [fish, gated])
    assert fish.accepted
    assert (frames[0]["accepted"], frames[0]["reason"]) == ("false", 'an outlier, "far" off')


def test_a_fish_without_an_estimate_is_written_at_the_end(tmp_path: Path, messages: list[Message]):
    fish = next(m for m in messages if isinstance(m, LocalizedFish))
    lengths, frames = write(tmp_path, [fish])
    assert lengths == []
    assert [row["accepted"] for row in frames] == ["true"]


def test_rows_are_on_disk_as_they_come(tmp_path: Path, messages: list[Message]):
    tables = Tables(tmp_path)
    write_all(tables, messages)
    assert len(read(tmp_path / "lengths.csv")) == 2
    assert len(read(tmp_path / "frames.csv")) == 12 + 8
    tables.close()


def test_blanks_for_what_is_not_known(tmp_path: Path):
    lengths, frames = write(tmp_path, list(run(2, num_fish=1, calibrated=False)))
    assert [lengths[0][name] for name in ("length_mm", "length_std_mm", "ci95_low_mm")] == [""] * 3
    assert frames[0]["length_mm"] == frames[0]["head_x_mm"] == frames[0]["tail_z_mm"] == ""
    assert frames[0]["bending_ratio"] != ""
    assert frames[0]["head_u"] != ""


@given(st.integers(-(2**63), 2**63 - 1))
def test_seconds_are_exact(timestamp_ns: int):
    text = seconds(timestamp_ns)
    assert Decimal(text) == Decimal(timestamp_ns).scaleb(-9)
    assert len(text.partition(".")[2]) == 9


def test_a_full_disk_is_refused_in_one_line(tmp_path: Path, messages: list[Message]):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    tables = Tables(tmp_path)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OutputError, match=r"frames\.csv.*room"):
            write_all(tables, messages)
        tables.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    text = (tmp_path / "frames.csv").read_text()
    assert text.endswith("\n")
    assert 0 < len(read(tmp_path / "frames.csv")) < 20
