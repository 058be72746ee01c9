"""A folder of clips: growing, damaged, gone on with after a restart."""

import itertools
import os
import shutil
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.sources.folders import ClipFolder
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings, ResumePoint
from tests.support.sources import h264

AT_ONCE = ReadFramesSettings(clips_wait_s=0.0)
OLD_S = 1_700_000_000


def clip(
    path: Path,
    *,
    first: int,
    num_frames: int = 4,
    size: tuple[int, int] = (64, 48),
    fps: float = 25.0,
    is_combed: bool = False,
) -> Path:
    """Grey pictures `first`, `first` + 1, ..., `fps` a second; whole for long.

    `is_combed`: every second line is brighter.
    """
    draft = path.with_suffix(".draft.avi")
    writer = cv2.VideoWriter(str(draft), cv2.VideoWriter_fourcc(*"FFV1"), fps, size)
    for k in range(first, first + num_frames):
        image = np.full((size[1], size[0], 3), 8 * k % 200, np.uint8)
        image[1::2] += np.uint8(50 * is_combed)
        writer.write(image)
    writer.release()
    os.utime(draft, (OLD_S + first, OLD_S + first))
    return draft.rename(path)


def numbers(frames: list[Frame]) -> list[int]:
    return [round(float(frame.image.mean()) / 8) for frame in frames]


def test_clips_follow_each_other_by_name(tmp_path: Path):
    for number in (10, 9, 1):
        clip(tmp_path / f"rail_{number}.avi", first=number)
    folder = open_source(str(tmp_path), AT_ONCE)
    assert isinstance(folder, ClipFolder)
    frames = list(folder)
    assert numbers(frames) == [1, 2, 3, 4, 9, 10, 11, 12, 10, 11, 12, 13]
    assert [frame.frame_index for frame in frames] == list(range(1, 13))
    assert [frame.source for frame in frames[::4]] == ["rail_1.avi", "rail_9.avi", "rail_10.avi"]
    times = [frame.timestamp_ns for frame in frames]
    assert all(a < b for a, b in itertools.pairwise(times))
    # Each ends when it was last written, but the last, which would begin before that.
    assert times[4] == (OLD_S + 9) * 10**9 - 160_000_000
    assert times[8] - times[4] == 10**9
    assert folder.warnings == []


def test_interlaced_clips_are_named_once(tmp_path: Path):
    for name in ("a", "b"):
        clip(tmp_path / f"{name}.avi", first=1, num_frames=60, is_combed=True)
    folder = open_source(str(tmp_path), AT_ONCE)
    assert len(list(folder)) == 120
    (warning,) = folder.warnings
    assert "interlaced" in warning


def test_clips_that_overlap_in_time_are_set_one_after_the_other(tmp_path: Path):
    for name in ("a", "b"):
        clip(tmp_path / f"{name}.avi", first=1)
    times = [frame.timestamp_ns for frame in open_source(str(tmp_path), AT_ONCE)]
    assert {b - a for a, b in itertools.pairwise(times)} == {40_000_000}


def test_clips_after_one_with_a_wrong_time_are_said_once(tmp_path: Path):
    for number in (1, 2, 3, 4):
        clip(tmp_path / f"{number}.avi", first=number)
    os.utime(tmp_path / "2.avi", (OLD_S + 10**7,) * 2)
    folder = open_source(str(tmp_path), AT_ONCE)
    times = [frame.timestamp_ns for frame in folder]
    assert all(a < b for a, b in itertools.pairwise(times))
    (warning,) = folder.warnings
    assert warning.startswith("3.avi: by its time of change it is 9999997 s older")


def test_a_clip_of_a_time_to_come_moves_no_other(tmp_path: Path):
    for number in (1, 2, 3):
        clip(tmp_path / f"{number}.avi", first=number)
    os.utime(tmp_path / "2.avi", (OLD_S + 10**10,) * 2)
    folder = open_source(str(tmp_path), AT_ONCE)
    times = [frame.timestamp_ns for frame in folder]
    assert [round((time_ns - times[0]) / 1e6) for time_ns in times[4::4]] == [160, 2000]
    (warning,) = folder.warnings
    assert warning.startswith("2.avi: by its time of change it ends in ")


def test_copies_of_long_clips_are_not_early(tmp_path: Path):
    """They have the times of their making: each ends seconds after the one before."""
    for number in (1, 2, 3):
        clip(tmp_path / f"{number}.avi", first=number, num_frames=25, fps=0.005)
    folder = open_source(str(tmp_path), AT_ONCE)
    assert len(list(folder)) == 75
    assert folder.warnings == []


def test_a_clip_that_can_not_be_used_is_left_out(tmp_path: Path):
    clip(tmp_path / "1.avi", first=1)
    (tmp_path / "2.avi").write_bytes(bytes(range(256)) * 40)
    clip(tmp_path / "3.avi", first=3, size=(32, 48))
    clip(tmp_path / "4.avi", first=5)
    folder = open_source(str(tmp_path), AT_ONCE)
    assert numbers(list(folder)) == [1, 2, 3, 4, 5, 6, 7, 8]
    assert len(folder.warnings) == 2
    assert "2.avi: expected a video" in folder.warnings[0]
    assert "3.avi: expected 64x48 px as the first clip has, got 32x48 px" in folder.warnings[1]


def test_a_damaged_clip_is_said_at_once_and_the_next_one_is_read(tmp_path: Path):
    for number in (1, 2, 3):
        clip(tmp_path / f"{number}.avi", first=number, num_frames=20)
    os.truncate(tmp_path / "2.avi", (tmp_path / "2.avi").stat().st_size * 3 // 4)
    os.utime(tmp_path / "2.avi", (OLD_S, OLD_S))
    folder, said, frames = open_source(str(tmp_path), AT_ONCE), list[str](), list[Frame]()
    folder.listen(lambda line: said.append(f"{line[:5]} before {len(frames)}"))
    for frame in folder:
        frames.append(frame)
    assert 40 < len(frames) < 60
    assert {frame.source for frame in frames[-20:]} == {"3.avi"}
    assert folder.warnings == []
    assert said == [f"2.avi before {len(frames) - 20}"]


def test_a_restart_reads_what_was_not_read(tmp_path: Path):
    for first in (1, 5, 9):
        clip(tmp_path / f"{first}.avi", first=first)
    folder = ClipFolder(tmp_path, AT_ONCE)
    folder.resume(
        ResumePoint(
            after_ns=2 * OLD_S * 10**9,
            clips_done=frozenset({"1.avi"}),
            frames_done={"5.avi": 3},
        )
    )
    frames = list(folder)
    assert numbers(frames) == [8, 9, 10, 11, 12]
    assert frames[0].timestamp_ns > 2 * OLD_S * 10**9


def test_a_restart_changes_no_capture_time(tmp_path: Path):
    for number, name in enumerate(("1.avi", "2.avi"), start=1):
        clip(tmp_path / name, first=number, num_frames=20)
    os.utime(tmp_path / "2.avi", (OLD_S + 30, OLD_S + 30))
    times = [frame.timestamp_ns for frame in ClipFolder(tmp_path, AT_ONCE)]
    for num_done in (9, 20, 33):
        folder = ClipFolder(tmp_path, AT_ONCE)
        in_work = {f"{1 + num_done // 20}.avi": num_done % 20}
        done = frozenset({"1.avi"} if num_done >= 20 else ())
        point = ResumePoint(after_ns=times[num_done - 1], clips_done=done, frames_done=in_work)
        folder.resume(point)
        assert [frame.timestamp_ns for frame in folder] == times[num_done:]


def test_what_follows_a_clip_that_was_done_begins_after_it(tmp_path: Path):
    """Even if the last capture time was not noted any more, as by a crash."""
    for number, name in enumerate(("1.avi", "2.avi"), start=1):
        clip(tmp_path / name, first=number, num_frames=20)
    times = [frame.timestamp_ns for frame in ClipFolder(tmp_path, AT_ONCE)]
    folder = ClipFolder(tmp_path, AT_ONCE)
    folder.resume(ResumePoint(after_ns=times[5], frames_done={"1.avi": 20}))
    assert [frame.timestamp_ns for frame in folder] == times[20:]


def test_a_clip_is_read_when_it_has_come_and_not_before(tmp_path: Path):
    clip(tmp_path / "1.avi", first=1)
    whole = clip(tmp_path / "whole", first=5)
    folder = ClipFolder(tmp_path, ReadFramesSettings(clips_wait_s=8.0))

    def copy_slowly() -> None:
        data = whole.read_bytes()
        with (tmp_path / "2.avi").open("wb") as file:
            for part in (data[: len(data) // 3], data[len(data) // 3 :]):
                file.write(part)
                file.flush()
                time.sleep(1.0)

    thread = threading.Thread(target=copy_slowly)
    thread.start()
    frames = list(itertools.islice(folder, 8))
    thread.join()
    folder.close()
    assert numbers(frames) == [1, 2, 3, 4, 5, 6, 7, 8]
    assert folder.warnings == []


@pytest.mark.slow  # waits for seconds
def test_a_pause_is_announced_once_if_no_clip_comes(tmp_path: Path):
    clip(tmp_path / "1.avi", first=1)
    folder, announced = ClipFolder(tmp_path, ReadFramesSettings(clips_wait_s=7.0)), list[int]()
    folder.announce_pauses(lambda: announced.append(len(seen)))
    seen: list[Frame] = []
    for frame in folder:
        seen.append(frame)
    assert (len(seen), announced) == (4, [4])


def test_a_clip_that_grows_after_it_was_read_is_read_on(tmp_path: Path):
    clip(tmp_path / "1.ts", first=1)
    whole = clip(tmp_path / "whole", first=1, num_frames=9)
    folder = ClipFolder(tmp_path, AT_ONCE)
    frames = iter(folder)
    first = list(itertools.islice(frames, 4))
    (tmp_path / "1.ts").write_bytes(whole.read_bytes())
    os.utime(tmp_path / "1.ts", (OLD_S + 60, OLD_S + 60))
    rest = list(frames)
    assert numbers(first + rest) == list(range(1, 10))
    assert all(a.timestamp_ns < b.timestamp_ns for a, b in itertools.pairwise(first + rest))
    assert folder.warnings == ["1.ts: grew after its 4 frames were read"]


def test_a_clip_that_replaces_one_of_its_name_is_said(tmp_path: Path):
    """As by a recorder that begins its names again: its fish would be missed in silence."""
    for number in (1, 2):
        clip(tmp_path / f"{number}.avi", first=number)
    folder = ClipFolder(tmp_path, AT_ONCE)
    frames = iter(folder)
    first = list(itertools.islice(frames, 4))
    os.utime(clip(tmp_path / "1.avi", first=1), (OLD_S + 60, OLD_S + 60))
    assert numbers([*first, *frames]) == [1, 2, 3, 4, 2, 3, 4, 5]
    assert len(folder.warnings) == 1
    assert "1.avi: was written again after it was read" in folder.warnings[0]


def test_a_clip_that_is_renamed_after_it_was_read_is_not_read_again(tmp_path: Path):
    """As by a recorder that names a clip when it is done; also after a restart."""
    for number in (1, 2):
        clip(tmp_path / f"{number}.avi", first=number)
    folder, done = ClipFolder(tmp_path, AT_ONCE), list[str]()
    folder.resume(ResumePoint(mark_done=done.append))
    frames = iter(folder)
    first = list(itertools.islice(frames, 5))
    (tmp_path / "1.avi").rename(tmp_path / "7.avi")
    assert numbers([*first, *frames]) == [1, 2, 3, 4, 2, 3, 4, 5]
    assert done == ["7.avi"]
    assert folder.warnings == ["7.avi: is 1.avi by another name, so is not read again"]
    clip(tmp_path / "7.avi", first=1, num_frames=6)
    assert numbers([*folder]) == [5, 6]


def test_a_clip_that_is_renamed_while_another_is_left_out_is_not_read_again(tmp_path: Path):
    clip(tmp_path / "1.avi", first=1)
    clip(tmp_path / "2.avi", first=2, size=(32, 24))
    folder, notices = ClipFolder(tmp_path, AT_ONCE), list[str]()

    def rename(line: str) -> None:
        notices.append(line)
        if "left out" in line:
            (tmp_path / "1.avi").rename(tmp_path / "7.avi")

    folder.listen(rename)
    assert numbers([*folder]) == [1, 2, 3, 4]
    assert notices[1:] == ["7.avi: is 1.avi by another name, so is not read again"]


def test_only_the_clip_that_was_read_is_not_read_by_another_name(tmp_path: Path):
    """Its old name may be another's by now; another that is as large and old was there before."""
    for number in (1, 2):
        clip(tmp_path / f"{number}.avi", first=5)
    folder = ClipFolder(tmp_path, AT_ONCE)
    frames = iter(folder)
    first = next(frames)
    (tmp_path / "1.avi").rename(tmp_path / "7.avi")
    clip(tmp_path / "1.avi", first=9)
    assert numbers([first, *frames]) == [5, 6, 7, 8] * 2
    assert folder.warnings[0] == "7.avi: is 1.avi by another name, so is not read again"


def test_closing_ends_the_wait_for_a_clip(tmp_path: Path):
    clip(tmp_path / "1.avi", first=1)
    folder = ClipFolder(tmp_path, ReadFramesSettings(clips_wait_s=1e9))
    threading.Timer(0.5, folder.close).start()
    assert len(list(folder)) == 4


def test_a_folder_without_a_readable_clip_is_refused(tmp_path: Path):
    (tmp_path / "1.avi").write_bytes(bytes(range(256)) * 40)
    with pytest.raises(SourceError, match=r"1\.avi: expected a video"):
        open_source(str(tmp_path), AT_ONCE)
    clip(tmp_path / "2.avi", first=1)
    shutil.copy2(tmp_path / "2.avi", tmp_path / "3.avi")
    assert len(list(open_source(str(tmp_path), AT_ONCE))) >= 4


@pytest.mark.parametrize(("cut", "is_cut_off"), [("a", False), ("b", True)])
def test_a_last_clip_that_is_cut_off_is_said(tmp_path: Path, cut: str, is_cut_off: bool):
    """After another one fish are seen on."""
    for number, name in enumerate("ab"):
        clip(tmp_path / f"{name}.avi", first=number, num_frames=20)
    path = tmp_path / f"{cut}.avi"
    os.truncate(path, path.stat().st_size * 3 // 4)
    os.utime(path, (OLD_S, OLD_S))
    folder = open_source(str(tmp_path), AT_ONCE)
    assert 20 < len(list(folder)) < 40
    assert folder.is_cut_off == is_cut_off
    assert any("damaged" in line for line in folder.warnings)


def test_a_clip_whose_clock_began_before_it_ends_when_it_was_written(tmp_path):
    path = h264(tmp_path / "7.mkv", first_ms=3_600_000)  # as `ffmpeg -f segment` numbers on
    os.utime(path, (OLD_S, OLD_S))
    times = [frame.timestamp_ns for frame in open_source(str(tmp_path), AT_ONCE)]
    assert times[0] / 1e9 == pytest.approx(OLD_S - 0.4, abs=0.1)


def test_pictures_of_another_size_are_not_squeezed_into_that_of_the_first(tmp_path):
    small, broad = h264(tmp_path / "s.ts"), h264(tmp_path / "b.ts", size=(160, 48))
    joined = small.read_bytes() + broad.read_bytes()
    broad.unlink()
    (tmp_path / "t.ts").write_bytes(joined)
    h264(tmp_path / "u.ts")
    folder = open_source(str(tmp_path), AT_ONCE)
    frames = list(folder)
    assert {frame.source for frame in frames} == {"s.ts", "t.ts", "u.ts"}
    assert sum(frame.source == "t.ts" for frame in frames) <= 10
    assert any("160x48 px" in line for line in folder.warnings)
