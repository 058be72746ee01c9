"""Recordings in segments, what a crash leaves of them, and how a run goes on after it."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from fnmatch import fnmatch
from functools import partial
from itertools import takewhile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from stream_dmr.errors import OutputError
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.evidence.verify_signatures import check_signatures
from stream_dmr.files import FolderLock
from stream_dmr.messages import Frame, LengthEstimate, LocalizedFish, Message
from stream_dmr.recording.codec import decode
from stream_dmr.recording.reading import decoded_messages, open_recordings
from stream_dmr.recording.record import Record, SinkStates
from stream_dmr.recording.recorder import Recorder, open_recording_files
from stream_dmr.recording.repair import repair_recordings
from stream_dmr.recording.segments import UnfinishedFiles, last_segment_number, open_segments
from stream_dmr.recording.topics import TOPICS, RecordingSettings
from stream_dmr.store.ledger import load_public_key, make_key
from stream_dmr.store.run_tables import FramesTable
from stream_dmr.store.schema import INTERRUPTED, MAY_COUNT_TWICE
from stream_dmr.web.views import frame_images, recorded_source
from tests.support.command import invoke, rows
from tests.support.reading import read_header, read_messages
from tests.support.recorded_run import assert_same, header, run
from tests.support.tiny_clip import HEIGHT, QUICK, WIDTH, write_clip

NUM_FRAMES, SLOWER = 24, 20  # 2 fish in 24 frames, 2/3 s from one to the next
SEGMENT_S = 3.0  # 5 frames
SEGMENT_FILES = "stream_dmr.recording.segments"
SETTINGS = RecordingSettings(rrd=False, flush_s=1e-9, segment_s=SEGMENT_S)


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    """As a chain gives them: each stage a frame behind the one before it."""
    slow = [replace(m, timestamp_ns=m.timestamp_ns * SLOWER) for m in run(NUM_FRAMES)]
    stages = {kind: number for number, kind in enumerate(TOPICS)}
    return sorted(slow, key=lambda m: (is_final(m), m.frame_index + stages[type(m)]))


def is_final(message: Message) -> bool:
    return isinstance(message, LengthEstimate) and message.is_final


def recorder(out: Path, settings: RecordingSettings = SETTINGS, **more) -> Recorder:
    notices: list[str] = []
    files = partial(open_segments, on_notice=notices.append)
    return Recorder(out, header(), settings, files=files, **more)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, messages: list[Message]) -> Path:
    """The segments of a run that ended well."""
    out = tmp_path_factory.mktemp("whole")
    with recorder(out) as segments:
        for message in messages:
            segments.write(message)
    return out


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory, messages: list[Message]) -> Path:
    """What a crash leaves while the stages are on both sides of the first cut."""
    out = tmp_path_factory.mktemp("torn")
    live = recorder(tmp_path_factory.mktemp("live"), in_one_thread=True)
    with live:
        for message in takewhile(lambda m: m.frame_index <= 8, messages):
            live.write(message)
        for path in (tmp_path_factory.getbasetemp()).glob("live*/recording*"):
            shutil.copy(path, out)
    return out


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("recording*"))


def read_by_others(path: Path) -> list[tuple[str, int]]:
    """Topic and log time of every message, by the mcap library's own reader."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [(channel.topic, m.log_time) for _, channel, m in reader.iter_messages()]


def test_segments_hold_every_message_once_and_are_cut_between_frames(
    whole: Path, messages: list[Message]
):
    assert names(whole) == [f"recording-{n:06d}.mcap" for n in range(1, 6)]
    for kind in TOPICS:
        expected = [m for m in messages if isinstance(m, kind) and not isinstance(m, Frame)]
        found = [m for m in read_messages(whole, [kind]) if not isinstance(m, Frame)]
        for one, other in zip(
            sorted(expected, key=is_final), sorted(found, key=is_final), strict=True
        ):
            assert (one.frame_index, one.track_id) == (other.frame_index, other.track_id)
    cuts = []
    for path in sorted(whole.glob("*.mcap")):
        assert read_by_others(path)
        found = list(read_messages(path))
        indices = {m.frame_index for m in found if not is_final(m)}
        assert indices == set(range(min(indices), max(indices) + 1))
        assert {m.frame_index for m in found if isinstance(m, Frame)} == indices
        cuts.append(min(indices))
    assert cuts == [1, 6, 11, 16, 21]


def test_recording_goes_on_when_the_folder_was_away(tmp_path: Path, messages: list[Message]):
    out, away, notices = tmp_path / "out", tmp_path / "away", list[str]()
    states = SinkStates()
    files = partial(open_segments, on_notice=notices.append, states=states)
    out.mkdir()
    with Recorder(
        out,
        header(),
        SETTINGS,
        sinks=[FramesTable(out, is_endless=True)],
        files=files,
        on_refusal=notices.append,
        states=states,
        in_one_thread=True,
    ) as segments:
        for message in messages:
            if message.frame_index == 3 and out.exists() and not away.exists():
                out.rename(away)
            if message.frame_index == 13 and away.exists():
                failing = states.problems()
                away.rename(out)
            segments.write(message)
    assert sorted(problem.split()[0] for problem in failing) == ["frames.csv", "recording-*.mcap"]
    assert states.problems() == []
    assert all(state.last_error for state in states.all() if state.name == "recording-*.mcap")
    assert all(name.endswith(".mcap") for name in names(out))
    recorded = {m.frame_index for m in read_messages(out, [Frame])}
    assert recorded == set(range(1, NUM_FRAMES + 1))  # into the file that was open


def test_a_segment_that_was_refused_twice_is_written_to_its_end(
    tmp_path: Path, messages: list[Message]
):
    refused = 0

    def refuse_twice(out_dir: Path, *args, **kwargs):
        nonlocal refused
        if kwargs["segment_number"] == 2 and refused < 2:
            refused += 1
            raise OutputError(f"{out_dir}: no room")
        return open_recording_files(out_dir, *args, **kwargs)

    notices: list[str] = []
    files = partial(open_segments, on_notice=notices.append)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{SEGMENT_FILES}.open_recording_files", refuse_twice)
        with Recorder(tmp_path, header(), SETTINGS, files=files, in_one_thread=True) as segments:
            for message in messages:
                segments.write(message)
    assert refused == 2
    assert [line for line in notices if "tried again" not in line] == []
    recorded = {m.frame_index for m in read_messages(tmp_path, [Frame])}
    assert recorded == set(range(1, NUM_FRAMES + 1))


def test_what_no_segment_holds_is_said_at_the_end(tmp_path: Path, messages: list[Message]):
    notices: list[str] = []
    files = partial(open_segments, on_notice=notices.append)
    with (
        pytest.MonkeyPatch.context() as patch,
        Recorder(tmp_path, header(), SETTINGS, files=files, in_one_thread=True) as segments,
    ):
        for message in messages:
            if message.frame_index == NUM_FRAMES - 3:
                patch.setattr(f"{SEGMENT_FILES}.free_bytes", lambda folder: 0)
            segments.write(message)
    recorded = {m.frame_index for m in read_messages(tmp_path, [Frame])}
    assert recorded == set(range(1, NUM_FRAMES - 3))
    assert notices[-1].startswith("at least 4 frames are in no recording")
    assert "lengths.db" not in notices[-1]  # the disk may have refused them, too


def test_a_recording_is_read_as_it_is_while_a_run_writes_and_renames_it(
    tmp_path: Path, messages: list[Message]
):
    lock = FolderLock(tmp_path)
    with recorder(tmp_path, in_one_thread=True) as segments:
        for message in messages[:60]:
            segments.write(message)
        parts = list(tmp_path.glob("*.part"))
        assert parts
        listed = open_recordings([tmp_path])
        before = [m for m, _ in decoded_messages(listed, [LocalizedFish])]
        assert len(before) > 3
        assert [line for line in listed.warnings if "still being written" in line]
        for message in messages[60:]:
            segments.write(message)
        assert not any(part.exists() for part in parts)
        after = [m for m, _ in decoded_messages(listed, [LocalizedFish])]
    assert [m.frame_index for m in after] == [m.frame_index for m in before]
    assert not [line for line in listed.warnings if "lost" in line]
    lock.release()


def test_a_file_that_gets_its_name_while_the_folder_is_read_counts_once(whole: Path):
    first = whole / "recording-000001.mcap"
    assert read_header(first.with_name(f"{first.name}.part")).source == read_header(first).source
    listed = [f"{first.name}.part", *names(whole)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Path,
            "glob",
            lambda self, pattern: (self / name for name in listed if fnmatch(name, pattern)),
        )
        recording = open_recordings([whole])
    assert len({m.frame_index for m, _ in decoded_messages(recording, [Frame])}) == NUM_FRAMES


def test_a_sink_that_broke_is_tried_again(tmp_path: Path, messages: list[Message]):
    class Breaking:
        name, num_written, breaks = "other.txt", 0, True

        def write(self, record: Record) -> None:
            if self.breaks:
                raise ConnectionError("gone")
            self.num_written += 1

        def close(self) -> None: ...

    sink, notices, now_s = Breaking(), list[str](), [0.0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stream_dmr.recording.recorder.time.monotonic", lambda: now_s[0])
        with recorder(
            tmp_path, sinks=[sink], on_refusal=notices.append, in_one_thread=True
        ) as segments:
            for message in messages[:7]:
                segments.write(message)
                now_s[0] += 1.1
            assert [line[-3:] for line in notices] == ["1 s", "2 s", "4 s"]
            assert segments.states.problems() == [
                "other.txt can't be written: ConnectionError: gone"
            ]
            sink.breaks = False
            now_s[0] += 60
            segments.write(messages[9])
            assert sink.num_written == 1
            assert segments.states.problems() == []


def test_a_segment_carries_the_fish_that_are_in_view(whole: Path, messages: list[Message]):
    for path in sorted(whole.glob("*.mcap")):
        first = min(m.frame_index for m in read_messages(path, [Frame]))
        carried = [decode(LocalizedFish, data) for data in open_recordings([path]).carried_over()]
        expected = [m for m in messages if isinstance(m, LocalizedFish) and m.frame_index < first]
        expected.sort(key=lambda m: (m.track_id, m.frame_index))
        assert len(carried) == len(expected)
        for one, other in zip(expected, carried, strict=True):
            assert_same(one, other)


def test_what_a_crash_left_is_made_whole(torn: Path, tmp_path: Path, messages: list[Message]):
    folder = Path(shutil.copytree(torn, tmp_path / "out"))
    assert names(folder) == ["recording-000001.mcap.part", "recording-000002.mcap.part"]
    before = [list(read_messages(path)) for path in sorted(folder.iterdir())]
    repairs = list(repair_recordings(folder))
    assert names(folder) == ["recording-000001.mcap", "recording-000002.mcap"]
    assert all("left unfinished by a crash" in repair.line for repair in repairs)
    for repair, expected in zip(repairs, before, strict=True):
        found = list(read_messages(repair.path))
        assert len(found) == len(expected) > 0
        for one, other in zip(expected, found, strict=True):
            assert_same(one, other)
        assert len(read_by_others(repair.path)) >= len(found)
    assert list(repair_recordings(folder)) == []


@given(share=st.floats(0, 1), rubbish=st.binary(max_size=40))
def test_any_beginning_of_a_recording_is_made_whole_or_set_aside(
    torn: Path, tmp_path_factory: pytest.TempPathFactory, share: float, rubbish: bytes
):
    folder = tmp_path_factory.mktemp("cut")
    part = folder / "recording-000001.mcap.part"
    data = (torn / part.name).read_bytes()
    part.write_bytes(data[: round(share * len(data))] + rubbish)
    (repair,) = repair_recordings(folder)
    assert "left unfinished" in repair.line
    if repair.path.suffix == ".mcap":
        assert read_by_others(repair.path) is not None
        kept = list(read_messages(repair.path))
        whole = list(read_messages(torn / part.name))
        for one, other in zip(whole[: len(kept)], kept, strict=True):
            assert_same(one, other)
    else:
        assert names(folder) == ["recording-000001.mcap.part.damaged"]


@pytest.mark.parametrize("size", [0, 7, 8, 9, 16, 40])
def test_a_recording_that_was_only_begun_is_set_aside(torn: Path, tmp_path: Path, size: int):
    part = tmp_path / "recording-000001.mcap.part"
    part.write_bytes((torn / part.name).read_bytes()[:size])
    list(repair_recordings(tmp_path))
    assert names(tmp_path) == ["recording-000001.mcap.part.damaged"]


def test_what_was_not_there_when_a_disk_refused_it_is_not_repaired(torn: Path, tmp_path: Path):
    folder = Path(shutil.copytree(torn, tmp_path / "out"))
    assert last_segment_number(folder) == 2
    notices, closed = list[str](), list[Path]()
    unfinished = UnfinishedFiles(on_notice=notices.append, on_closed=closed.append)
    for number in (2, 3):
        unfinished.add(folder / f"recording-00000{number}.mcap")
    shutil.copy(folder / "recording-000002.mcap.part", folder / "recording-000003.mcap.part")
    unfinished.finish()
    assert closed == [folder / "recording-000002.mcap"]
    assert names(folder)[-1] == "recording-000003.mcap.part"
    assert len(notices) == 1


def test_a_repair_replaces_no_recording(torn: Path, tmp_path: Path):
    folder = Path(shutil.copytree(torn, tmp_path / "out"))
    (folder / "recording-000001.mcap").write_bytes(b"precious")
    repair = next(repair_recordings(folder))
    assert repair.path.name == "recording-000001-1.mcap"
    assert (folder / "recording-000001.mcap").read_bytes() == b"precious"


def test_the_command_says_what_it_did(torn: Path, tmp_path: Path):
    folder = Path(shutil.copytree(torn, tmp_path / "out"))
    outcome = invoke(f"recover {folder}")
    assert outcome.code == 0
    assert len(outcome.out.splitlines()) == 2
    assert "nothing to repair" in invoke(f"recover {folder}").out
    assert "expected the folder of a run" in invoke(f"recover {folder / 'none'}").error


def test_a_length_that_only_the_recording_has_is_taken_over(tmp_path: Path):
    options = write_clip(tmp_path / "clip", fish=[[1, 2]] * 3)
    out = Path(options["--out"])
    assert invoke("run", options).code == 0
    csv = (out / "lengths.csv").read_text()
    with sqlite3.connect(out / "lengths.db") as database:
        database.execute("DELETE FROM fish WHERE track_id = 2")
    database.close()
    assert "fish 2" in invoke(f"recover {out}").out
    assert (out / "lengths.csv").read_text() == csv
    assert "nothing to repair" in invoke(f"recover {out}").out


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A measurement of clips, killed in the middle of a fish and started again."""
    folder = tmp_path_factory.mktemp("interrupted")
    make_key(folder / "key")
    options = write_clips(folder, num_frames=44) | {"--key": str(folder / "key")}
    out = Path(options["--out"])
    arguments = [part for item in options.items() for part in item]
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, "run", *arguments], capture_output=True, text=True
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert any(name.endswith(".part") for name in names(out))
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    assert "left unfinished by a crash" in outcome.err
    assert MAY_COUNT_TWICE in outcome.out  # in the table of fish
    return out


# Kills itself: another process might be late, and find the run at its end.
KILLED = """
import os, signal
from stream_dmr.cli.main import main
from stream_dmr.store.run_tables import FramesTable

write = FramesTable.write

def write_until_killed(table, record):
    write(table, record)
    if record.message.frame_index == 20:
        os.kill(os.getpid(), signal.SIGKILL)

FramesTable.write = write_until_killed
main()
"""

CLIPS = """
[detect_fish]
look_every_s = 60
[read_frames]
clips_wait_s = 0.5
[recording]
rrd = false
flush_s = 0.1
segment_s = 2.0
"""


def write_clips(folder: Path, *, num_frames: int) -> dict[str, str]:
    """A folder with a clip, a source without an end; return the options of `run`."""
    options = write_clip(folder)
    del options["--boxes"], options["--masks"]
    Path(options["--config"]).write_text(CLIPS + QUICK)
    (folder / "clips").mkdir()
    write_swaying_fish(folder / "clips" / "1.avi", num_frames=num_frames)
    return options | {"--source": str(folder / "clips")}


def write_swaying_fish(path: Path, *, num_frames: int) -> None:
    """A fish that motion finds, before a ground that GrabCutSegmenter can tell from it."""
    grains = np.random.default_rng(0).integers(120, 220, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    ground = cv2.GaussianBlur(grains, (5, 5), 0)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 7, (WIDTH, HEIGHT))
    for k in range(num_frames):
        center = round(80 + 40 * np.sin(k / 6)), 60 + k % 3
        video.write(cv2.ellipse(ground.copy(), center, (14, 40), 0, 0, 360, (40, 40, 40), -1))
    video.release()
    os.utime(path, (1.7e9, 1.7e9))


def test_fish_in_view_at_a_crash_are_finished_by_the_restart_and_say_so(interrupted: Path):
    with sqlite3.connect(interrupted / "lengths.db") as database:
        query = "SELECT track_id, frames_seen, flags FROM fish"
        fish = {i: (seen, json.loads(flags)) for i, seen, flags in database.execute(query)}
    database.close()
    flagged = {track_id for track_id, (_, flags) in fish.items() if flags == [INTERRUPTED]}
    assert flagged
    assert max(fish) > max(flagged)  # it came into view again
    recorded = Counter(m.track_id for m in localized(interrupted))
    assert {track_id: seen for track_id, (seen, _) in fish.items()} == recorded
    exported = {int(row["track_id"]): row["status"] for row in rows(interrupted / "lengths.csv")}
    assert exported.keys() == fish.keys()
    assert {i for i, status in exported.items() if MAY_COUNT_TWICE in status} == flagged
    assert {change.is_by_crash for change in verify(interrupted)[0]} == {True}
    assert invoke(f"verify {interrupted}").code == 3


def test_what_a_crash_interrupted_is_signed_all_the_same(interrupted: Path):
    check = check_signatures(interrupted, load_public_key(interrupted.parent / "key.pub"))
    assert check.changes == []
    assert [note for note in check.notes if "signed when a run found it" in note]
    assert not [note for note in check.notes if "not signed by the device" in note]


def test_a_table_of_frames_that_was_put_in_is_not_signed(interrupted: Path, tmp_path: Path):
    folder = Path(shutil.copytree(interrupted, tmp_path / "out"))
    shutil.copy(folder / "frames.csv", folder / "frames-000001.csv")
    check = check_signatures(folder, load_public_key(interrupted.parent / "key.pub"))
    assert "not signed by the device: 'frames-000001.csv'" in check.notes
    (folder / "frames.csv").write_text((folder / "frames.csv").read_text().replace(",1,", ",2,"))
    check = check_signatures(folder, load_public_key(interrupted.parent / "key.pub"))
    assert check.changes == ["frames.csv is not as it was signed"]


def test_every_frame_of_clips_is_found_again_over_a_restart(interrupted: Path):
    recording = open_recordings([interrupted])
    times = {m.timestamp_ns for m in read_messages(interrupted, [Frame])}
    source = recorded_source(recording)
    assert source == str(interrupted.parent / "clips")
    found = [time_ns for time_ns, _ in frame_images(recording, times, source, is_given=True)]
    assert sorted(set(found)) == sorted(times)


def test_a_report_takes_a_folder_of_clips(interrupted: Path, tmp_path: Path):
    page = tmp_path / "page.html"
    options = {"--source": str(interrupted.parent / "clips"), "--out": str(page)}
    outcome = invoke(f"report {interrupted}", options)
    assert outcome.code == 0, outcome.err
    assert MAY_COUNT_TWICE in page.read_text()
    options = {"--source": str(interrupted), "--out": str(page)}
    assert invoke(f"report {interrupted}", options).code == 2


def localized(path: Path) -> list[LocalizedFish]:
    return [m for m in read_messages(path, [LocalizedFish]) if isinstance(m, LocalizedFish)]


@pytest.mark.slow
def test_the_fish_of_a_folder_that_grew_are_found_again(tmp_path: Path):
    """Each run begins with nothing seen; also where a replay has made one recording of both."""
    options = write_clips(tmp_path, num_frames=10)
    again = {"--from": "crop", "--check": None}
    assert invoke("run", options).code == 0
    write_swaying_fish(tmp_path / "clips" / "2.avi", num_frames=10)
    assert invoke("run", options).code == 0
    assert {fish.track_id for fish in localized(Path(options["--out"]))} == {1, 2}
    joined = tmp_path / "joined"
    outcome = invoke(f"replay {options['--out']}", again | {"--out": str(joined)})
    assert outcome.code == 0, outcome.out + outcome.err
    outcome = invoke(f"replay {joined}", again)
    assert outcome.code == 0, outcome.out + outcome.err


# A single segment, below, is replayed from the others.
@pytest.mark.parametrize(
    "first",
    ["crop", *(pytest.param(one, marks=pytest.mark.slow) for one in ("fit", "localize", "smooth"))],
)
def test_consecutive_segments_are_what_was_recorded_over_a_crash(interrupted: Path, first: str):
    outcome = invoke(f"replay {interrupted}", {"--from": first, "--check": None})
    assert outcome.code == 0, outcome.out + outcome.err
    assert "recovered after a crash" in outcome.err


@pytest.mark.parametrize(
    "first", ["fit", pytest.param("localize", marks=pytest.mark.slow), "smooth"]
)
def test_every_segment_alone_is_what_was_recorded(interrupted: Path, first: str):
    paths = sorted(interrupted.glob("*.mcap"))
    assert len(paths) > 3
    left_out = list[bool]()
    for path in paths[:4]:
        outcome = invoke(f"replay {path}", {"--from": first, "--check": None})
        assert outcome.code == 0, f"{path.name}: {outcome.out}{outcome.err}"
        left_out.append("messages not compared" in outcome.out)
    assert left_out[:2] == [False, first == "fit"]
