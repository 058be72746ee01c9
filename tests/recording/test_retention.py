"""A disk that runs short: what goes, in which order, and that measuring goes on."""

import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from stream_dmr.files import free_bytes
from stream_dmr.messages import FishCrop, Frame, Message
from stream_dmr.recording.codec import stored_picture
from stream_dmr.recording.reading import open_recordings
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.retention import Retention
from stream_dmr.recording.segments import open_segments
from stream_dmr.recording.topics import TOPICS, RecordingSettings
from stream_dmr.store.run_tables import FramesTable
from tests.recording.test_segments import read_by_others, write_clips
from tests.support.command import invoke, rows
from tests.support.reading import read_messages
from tests.support.recorded_run import assert_same, header, run
from tests.support.small_disk import fill, small_disk

PER_SEGMENT, NUM_SEGMENTS = 3, 3
SLOWER = 30  # 1 s from frame to frame
SETTINGS = RecordingSettings(
    **{"rrd_messages": False, "flush_s": 1e-9, "segment_s": PER_SEGMENT - 0.5},
    **{"frames": "jpeg", "crops": "jpeg", "keep_free_gb": 0.0},
)


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    """Two fish in every segment that are in no other one."""
    found: list[Message] = []
    for message in run(PER_SEGMENT * NUM_SEGMENTS):
        changes: dict[str, object] = {"timestamp_ns": message.timestamp_ns * SLOWER}
        if not isinstance(message, Frame):
            changes["track_id"] = message.track_id + 2 * segment_of(message)
        if not getattr(message, "is_final", False):
            found.append(replace(message, **changes))
    return found


def track_of(crops: Iterator[Message]) -> Iterator[int]:
    return (
        crop.track_id for crop in crops if isinstance(crop, FishCrop) and crop.image is not None
    )


def segment_of(message: Message) -> int:
    return (message.frame_index - 1) // PER_SEGMENT


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, messages: list[Message]) -> Path:
    out = tmp_path_factory.mktemp("recorded")
    files = partial(open_segments, on_notice=pytest.fail)
    with Recorder(out, header(), SETTINGS, sinks=[FramesTable(out)], files=files) as recorder:
        for message in messages:
            recorder.write(message)
    (out / "lengths.db").write_bytes(b"the lengths")
    return out


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", kilobytes=40_000) as disk:
        yield disk


def make_room(folder: Path, *, free: int, marked: set[int]) -> list[str]:
    notices: list[str] = []
    retention = Retention(folder, free_bytes=free, flagged=lambda: marked, on_notice=notices.append)
    retention.free_space()
    retention.close()
    return notices


def state(folder: Path) -> list[str]:
    """Of each segment, what there is: its view, its pictures, and the rest."""
    found = []
    for number in range(1, NUM_SEGMENTS + 1):
        mcap = folder / f"recording-{number:06d}.mcap"
        parts = "v" if mcap.with_suffix(".rrd").exists() else ""
        if mcap.exists():
            parts += "r" if open_recordings([mcap]).is_thinned else "pr"
        found.append(parts)
    return found


def test_views_and_pictures_go_before_segments_and_marked_ones_last(recorded: Path, disk: Path):
    out = Path(shutil.copytree(recorded, disk / "out"))
    states = [state(out)]
    while any(states[-1]):
        (notice,) = make_room(out, free=free_bytes(disk) + 1, marked={1})
        assert "less than" in notice
        states.append(state(out))
    assert states == [
        ["vpr", "vpr", "vpr"],
        ["vpr", "pr", "vpr"],
        ["vpr", "r", "vpr"],
        ["vpr", "r", "pr"],
        ["vpr", "r", "r"],
        ["vpr", "", "r"],
        ["vpr", "", ""],
        ["pr", "", ""],
        ["r", "", ""],
        ["", "", ""],
    ]
    assert make_room(out, free=free_bytes(disk) + 1, marked=set()) == []
    assert (out / "lengths.db").read_bytes() == b"the lengths"


def test_what_is_left_of_a_segment_is_what_it_was(recorded: Path, disk: Path):
    out = Path(shutil.copytree(recorded, disk / "out"))
    while state(out) != ["r", "r", "r"]:
        make_room(out, free=free_bytes(disk) + 1, marked=set())
    kept = [kind for kind in TOPICS if kind not in (Frame, FishCrop)]
    for one, other in zip(read_messages(recorded, kept), read_messages(out, kept), strict=True):
        assert_same(one, other)
    before, after = (Counter(track_of(read_messages(p, [FishCrop]))) for p in (recorded, out))
    assert before.keys() == after.keys()  # each fish keeps some photographs
    assert all(0 < after[track] < before[track] for track in before)
    frames = [(path, open_recordings([path]).payloads([Frame])) for path in (recorded, out)]
    checksums = [[stored_picture(data).crc32 for _, data in payloads] for _, payloads in frames]
    assert checksums[0] == checksums[1]
    for path in sorted(out.glob("*.mcap")):
        assert read_by_others(path)
        before = open_recordings([recorded / path.name])
        assert list(open_recordings([path]).carried_over()) == list(before.carried_over())
        assert path.stat().st_size < 0.5 * (recorded / path.name).stat().st_size


def test_a_disk_without_room_to_rewrite_the_rest_loses_a_whole_segment(recorded: Path, disk: Path):
    out = Path(shutil.copytree(recorded, disk / "out"))
    for rrd in out.glob("*.rrd"):
        rrd.unlink()
    fill(disk)
    make_room(out, free=1, marked={1})
    assert state(out) == ["pr", "", "pr"]


def test_old_tables_of_frames_go_before_anything_else(recorded: Path, disk: Path):
    out = Path(shutil.copytree(recorded, disk / "out"))
    tables = [out / "frames-000001.csv", out / "frames-000002.csv"]
    for table in tables:
        table.write_bytes(bytes(10_000))
    before = (out / "frames.csv").read_bytes()
    (notice,) = make_room(out, free=free_bytes(disk) + 1, marked=set())
    assert "the table of frames of 1" in notice
    assert [table.exists() for table in tables] == [False, True]
    make_room(out, free=free_bytes(disk) + 20_000, marked=set())
    assert not tables[1].exists()
    assert (out / "frames.csv").read_bytes() == before
    assert state(out)[1:] == ["vpr", "vpr"]


def test_what_is_being_written_stays(recorded: Path, disk: Path):
    out = Path(shutil.copytree(recorded, disk / "out"))
    last = out / f"recording-{NUM_SEGMENTS:06d}.mcap"
    last.rename(last.with_name(f"{last.name}.part"))
    make_room(out, free=1 << 40, marked=set())
    assert {path.name for path in out.glob("recording*")} == {
        f"{last.name}.part",
        last.with_suffix(".rrd").name,
    }


def test_recording_goes_on_when_there_is_room_again(disk: Path, messages: list[Message]):
    notices: list[str] = []
    files = partial(open_segments, on_notice=notices.append)
    settings = SETTINGS.model_copy(update={"rrd": False})
    table = FramesTable(disk, is_endless=True)
    recorder = Recorder(
        disk,
        header(),
        settings,
        sinks=[table],
        files=files,
        on_refusal=notices.append,
        in_one_thread=True,
    )
    frames_csv = disk / "frames.csv"
    with recorder:
        for message in messages:
            if message.frame_index == 3 and isinstance(message, Frame):
                fill(disk)
            if message.frame_index == 5 and isinstance(message, Frame):
                assert notices
                (disk / "ballast").unlink()
            recorder.write(message)
    kept = {m.frame_index for m in read_messages(disk, [Frame])}
    assert {1, 2, 9} <= kept  # a new segment is tried every 5 s
    in_table = {int(row["frame_index"]) for row in rows(frames_csv)}
    assert {1, 2, 6, 7, 8, 9} <= in_table


def test_a_full_disk_does_not_stop_measuring(tmp_path: Path):
    with small_disk(tmp_path / "disk", kilobytes=300) as disk:
        options = write_clips(tmp_path / "clip", num_frames=24)
        options |= {"--out": str(disk / "out")}
        with_pictures(options)
        outcome = invoke("run", options)
        assert outcome.code == 0, outcome.err
        assert "nothing is recorded but lengths" in outcome.err
        assert "24 frames" in outcome.out
        with sqlite3.connect(disk / "out" / "lengths.db") as database:
            fish = database.execute("SELECT frames_seen FROM fish").fetchall()
        database.close()
        assert sum(seen for (seen,) in fish) > 15


def with_pictures(options: dict[str, str]) -> None:
    config = Path(options["--config"])
    config.write_text(config.read_text().replace("[recording]", PICTURES))


PICTURES = '[recording]\nframes = "jpeg"\njpeg_quality = 100\nkeep_free_gb = 0.004'


def test_masks_that_went_are_not_fitted_and_the_rest_is_what_was_recorded(tmp_path: Path):
    options = write_clips(tmp_path / "clip", num_frames=30)
    with_pictures(options)
    assert invoke("run", options).code == 0
    out = Path(options["--out"])
    with small_disk(tmp_path / "disk", kilobytes=4000) as disk:
        folder = Path(shutil.copytree(out, disk / "out"))
        first = folder / "recording-000001.mcap"
        while not open_recordings([first]).is_thinned:
            make_room(folder, free=free_bytes(disk) + 1, marked=set())
        assert "use --from localize" in invoke(f"replay {folder}", {"--from": "fit"}).error
        outcome = invoke(f"replay {folder}", {"--from": "localize", "--check": None})
        assert outcome.code == 0, outcome.out
