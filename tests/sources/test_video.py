import itertools
import struct
import subprocess
import sys
import wave
from collections import deque
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import SourceError
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.sources.decoder import Decoder
from stream_dmr.sources.open_source import open_source
from stream_dmr.sources.source import ReadFramesSettings, nominal_ns
from stream_dmr.sources.video_file import VideoFile, container_ns
from tests.support.sources import SETTINGS, h264, noise, read, refusal

SECOND_NS = 10**9


def write_video(path, *, codec="MJPG", fps=25.0, num_frames=12, size=(64, 48)):
    # OpenCV's own writer keeps odd sizes; its FFmpeg writer makes them even.
    is_odd = size[0] % 2 or size[1] % 2
    backend = cv2.CAP_OPENCV_MJPEG if is_odd else cv2.CAP_FFMPEG
    writer = cv2.VideoWriter(str(path), backend, cv2.VideoWriter_fourcc(*codec), fps, size)
    assert writer.isOpened()
    for seed in range(num_frames):
        writer.write(noise(seed, size=size))
    writer.release()
    return path


@pytest.mark.parametrize("lines", ["of one moment", "of two moments", "of gravel"])
def test_interlaced_pictures_are_named(tmp_path, lines):
    writer = cv2.VideoWriter(
        str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 15.0, (320, 240)
    )
    gravel = cv2.resize(noise(1, size=(320, 240)), (320, 240))
    for k in range(60):
        image = gravel.copy() if lines == "of gravel" else np.full((240, 320, 3), 60, np.uint8)
        earlier = image.copy()
        cv2.ellipse(image, (160, 180 - k), (14, 40), 20, 0, 360, (170, 170, 170), -1)
        cv2.ellipse(earlier, (166, 188 - k), (14, 40), 20, 0, 360, (170, 170, 170), -1)
        if lines == "of two moments":
            image[1::2] = earlier[1::2]
        writer.write(image)
    writer.release()
    film = VideoFile(tmp_path / "film.avi", SETTINGS)
    list(film)
    assert [("interlaced" in line) for line in film.warnings] == [True] * (
        lines == "of two moments"
    )


def cut(path, fraction=0.5):
    data = path.read_bytes()
    short = path.with_stem(path.stem + "_cut")
    short.write_bytes(data[: int(len(data) * fraction)])
    return short


@pytest.mark.parametrize(
    ("name", "codec", "fps"),
    [
        ("a.mp4", "mp4v", Fraction(30)),
        ("b.mp4", "mp4v", Fraction(24)),
        ("c.avi", "MJPG", Fraction(25, 2)),
        ("d.avi", "FFV1", Fraction(15)),
    ],
)
def test_timestamps_of_a_constant_rate_are_exact(tmp_path, name, codec, fps):
    opened, frames = read(write_video(tmp_path / name, codec=codec, fps=float(fps)))
    assert [f.frame_index for f in frames] == list(range(1, 13))
    assert [f.timestamp_ns for f in frames] == [round(k * SECOND_NS / fps) for k in range(12)]
    assert (opened.num_frames, opened.width, opened.height) == (12, 64, 48)
    assert opened.fps == pytest.approx(float(fps), rel=1e-4)
    assert opened.warnings == []


@pytest.mark.parametrize("num_kept", [1, 3, 40])
def test_a_part_of_a_picture_stays_as_it_is_while_others_are_decoded(tmp_path, num_kept):
    kept, seen = deque(maxlen=num_kept), []
    for frame in VideoFile(write_video(tmp_path / "a.avi", num_frames=40), SETTINGS):
        kept.append(frame.image[8:40:2].T)
        seen.append(kept[-1].copy())
        del frame
        np.testing.assert_array_equal(np.array(kept), np.array(seen[-num_kept:]))
    assert len(np.unique(np.array(seen), axis=0)) == 40


def test_matroska_keeps_its_whole_milliseconds(tmp_path):
    _, frames = read(write_video(tmp_path / "a.mkv", fps=30.0))
    assert [f.timestamp_ns for f in frames[:4]] == [0, 33_000_000, 67_000_000, 100_000_000]


def test_lossless_pictures_come_back_in_order(tmp_path):
    _, frames = read(write_video(tmp_path / "a.avi", codec="FFV1"))
    for seed, frame in enumerate(frames):  # FFV1 stores YUV here, so colours are rounded
        difference = cv2.absdiff(frame.image.mean(axis=2), noise(seed).mean(axis=2))
        assert difference.mean() < 12
        assert frame.source == "a.avi"


def test_odd_sizes(tmp_path):
    opened, frames = read(write_video(tmp_path / "odd.avi", size=(641, 359), num_frames=3))
    assert (opened.width, opened.height) == (641, 359)
    assert {f.image.shape for f in frames} == {(359, 641, 3)}


def test_a_colon_in_a_relative_path_is_no_protocol(tmp_path, monkeypatch):
    write_video(tmp_path / "rail:1.avi", num_frames=2)
    monkeypatch.chdir(tmp_path)
    assert len(read("rail:1.avi")[1]) == 2


@pytest.mark.parametrize("name", ["a.avi", "a.mkv"])
def test_what_decodes_of_a_cut_video_is_read_and_the_rest_reported(tmp_path, name):
    whole = read(write_video(tmp_path / name))[1]
    opened, frames = read(cut(tmp_path / name))
    assert 3 <= len(frames) < 12
    assert opened.is_cut_off
    assert opened.warnings == [
        f"{Path(name).stem}_cut{Path(name).suffix}: the file promises 12 frames, only "
        f"{len(frames)} could be read; it seems cut off or damaged"
    ]
    for frame, original in zip(frames[:-1], whole, strict=False):
        np.testing.assert_array_equal(frame.image, original.image)


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "mp4v"), ("a.avi", "MJPG")])
@pytest.mark.parametrize("filling", [bytes(60), noise(1).tobytes()[:60]])
def test_what_ffmpeg_makes_up_is_said(tmp_path, name, codec, filling):
    """All frames come, so that neither their number nor OpenCV shows it."""
    _, whole = read(write_video(tmp_path / name, codec=codec, num_frames=40))
    data = bytearray((tmp_path / name).read_bytes())
    data[len(data) // 2 : len(data) // 2 + len(filling)] = filling
    (tmp_path / name).write_bytes(data)
    opened, frames = read(tmp_path / name)
    assert (len(frames), opened.is_cut_off) == (40, False)
    differ = [a for a, b in zip(frames, whole, strict=True) if not np.array_equal(a.image, b.image)]
    (line,) = opened.warnings
    assert abs(int(line.partition("about frame ")[2].split()[0]) - differ[0].frame_index) <= 2


def test_a_matroska_of_variable_rate_is_whole_where_its_time_is(tmp_path):
    """OpenCV promises duration x mean rate: here 0.48 s x 31 frames/s."""
    write_video(tmp_path / "a.mkv")
    opened = open_source(str(tmp_path / "a.mkv"), SETTINGS)
    opened.num_frames, opened.fps = 15, 31.25
    assert (len(list(opened)), opened.warnings, opened.num_frames) == (12, [], 12)


def test_stopping_early_is_no_damage(tmp_path):
    reader = ReadFrames(str(write_video(tmp_path / "a.avi")), SETTINGS)
    frames = []
    for frame in reader:
        frames.append(frame)
        if len(frames) == 4:
            reader.close()
    assert len(frames) == 4
    assert reader.source.warnings == []


def test_refuses_what_is_no_video(tmp_path, capfd):
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "noise.mp4").write_bytes(bytes(range(256)) * 40)
    (tmp_path / "boxes.txt").write_text("1,1,576.0,530.3,54.7,197.0,1,1,1.0\n" * 50)
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(16000))
    (tmp_path / "huge.mp4").write_bytes(b"\0\0\0\1ftyp" + 8 * b"\xff")  # says a box of its size
    write_video(tmp_path / "whole.mp4", codec="mp4v")
    assert "empty file" in refusal(tmp_path / "empty.mp4")
    assert "no picture in it can be decoded" in refusal(tmp_path / "noise.mp4")
    assert "text file" in refusal(tmp_path / "boxes.txt")
    assert "audio file" in refusal(tmp_path / "sound.wav")
    assert "(moov)" in refusal(tmp_path / "huge.mp4")
    assert "(moov)" in refusal(cut(tmp_path / "whole.mp4"))
    with pytest.raises(SourceError, match="silence_s = 0 s"):  # no wait is as short
        open_source(str(tmp_path / "whole.mp4"), SETTINGS.model_copy(update={"silence_s": 0.0}))
    assert "no such file" in refusal(tmp_path / "missing.mp4")
    assert capfd.readouterr() == ("", "")  # neither OpenCV nor FFmpeg speaks


def test_refuses_a_camera_and_a_stream_that_are_not_there():
    assert refusal("97").startswith("camera 97: expected")
    message = refusal("rtsp://mate:secret@127.0.0.1:9/rail")
    assert message.startswith("rtsp://127.0.0.1:9/rail: expected")


def stamps(milliseconds):
    times = []
    for frame_index, ms in enumerate(milliseconds, start=1):
        previous = times[-1] if times else -1
        times.append(container_ns(ms, frame_index=frame_index, fps=25.0, previous_ns=previous))
    return times


@pytest.mark.parametrize("missing", [0.0, float("nan")])
def test_missing_timestamps_follow_the_frame_rate(missing):
    assert stamps([missing] * 4) == [0, 40_000_000, 80_000_000, 120_000_000]


def test_timestamps_that_stand_still_or_step_back_are_pushed_on_without_drift():
    ms = [0.0, 40.0, 40.0, 35.0, 120.0]
    assert stamps(ms) == [0, 40_000_000, 40_000_001, 40_000_002, 120_000_000]


def test_the_clock_goes_on_where_files_were_joined(tmp_path):
    parts = [tmp_path / f"{number}.ts" for number in range(3)]
    for part in parts:
        write_video(part, codec="mp4v", num_frames=50)
    joined = tmp_path / "joined.ts"
    joined.write_bytes(b"".join(part.read_bytes() for part in parts))
    opened, frames = read(joined)
    times = np.array([frame.timestamp_ns for frame in frames])
    assert len(times) > 140  # FFmpeg drops a picture at a seam
    assert np.diff(times).min() > 20_000_000
    assert abs(times[-1] - nominal_ns(len(times), 25.0)) < 200_000_000
    [warning] = [line for line in opened.warnings if "goes back" in line]
    assert "joined.ts: its clock goes back by" in warning


def test_a_single_wrong_time_leaves_those_after_it_as_they_are(tmp_path, monkeypatch):
    write_video(tmp_path / "video.mp4", codec="mp4v", num_frames=80)
    sound, numbers = Decoder.read, itertools.count()

    def with_a_wrong_time(decoder, **given):
        picture = sound(decoder, **given)
        return replace(picture, milliseconds=200.0) if next(numbers) == 60 else picture

    monkeypatch.setattr(Decoder, "read", with_a_wrong_time)
    _, frames = read(tmp_path / "video.mp4")
    expected = [nominal_ns(number, 25.0) for number in range(1, 81)]
    assert [frame.timestamp_ns for frame in frames] == pytest.approx(expected, abs=1e7)


@given(st.lists(st.floats(), max_size=20))
def test_timestamps_strictly_increase_whatever_the_container_says(milliseconds):
    times = stamps(milliseconds)
    assert all(a < b for a, b in itertools.pairwise([-1, *times]))


@given(st.integers(0, 24 * 3600 * 90_000), st.sampled_from([90_000, 30_000, 12_800, 600, 25]))
def test_timestamps_are_exact_for_a_day(ticks, time_base):
    milliseconds = 1000.0 * (ticks * (1.0 / time_base))  # as OpenCV computes it
    if ticks and ticks / time_base <= 86_400:
        exact = Fraction(ticks * SECOND_NS, time_base)
        assert abs(stamps([milliseconds])[0] - exact) <= Fraction(52, 100)


@given(st.fractions(min_value=1, max_value=240, max_denominator=1001), st.integers(1, 10**6))
def test_nominal_times_are_whole_periods(fps, frame_index):
    exact = (frame_index - 1) * SECOND_NS / fps
    assert abs(nominal_ns(frame_index, float(fps)) - exact) <= 1


def test_frames_cannot_be_written_to(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), noise(1))
    [frame] = ReadFrames(str(tmp_path), SETTINGS)
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0] = 0


@pytest.mark.scenes
def test_a_real_clip_is_read_whole(real):
    opened, frames = read(real / "trout" / "fish.mp4")
    assert len(frames) == opened.num_frames == 668
    assert opened.warnings == []
    assert all(a.timestamp_ns < b.timestamp_ns for a, b in itertools.pairwise(frames))


def test_a_matroska_whose_clock_began_before_it_is_whole(tmp_path):
    opened, frames = read(h264(tmp_path / "a.mkv", first_ms=3_600_000))
    assert (opened.num_frames, len(frames), opened.warnings) == (10, 10, [])
    assert not opened.is_cut_off


def test_a_video_that_asks_to_be_turned_is_named_if_there_is_a_calibration(tmp_path):
    path = h264(tmp_path / "a.mp4")
    data = bytearray(path.read_bytes())
    start = data.find(b"tkhd") + 44  # the matrix of a track of version 0
    one = 1 << 16
    matrix = [-one, 0, 0, 0, -one, 0, 64 * one, 48 * one, 1 << 30]
    data[start : start + 36] = struct.pack(">9i", *matrix)
    path.write_bytes(data)
    opened = open_source(str(path), ReadFramesSettings(orientation="sensor"))
    (line,) = opened.warnings
    assert "turned by 180 degrees" in line
    opened.close()
    opened, _ = read(path)
    assert opened.warnings == []


def test_ffmpeg_is_told_to_be_quiet_in_this_process():
    code = "import os, stream_dmr.sources.video_file; print(os.environ['OPENCV_FFMPEG_LOGLEVEL'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "-8"


def test_frames_that_the_camera_of_an_avi_dropped_are_no_damage(tmp_path):
    path = write_avi_with_gaps(tmp_path / "a.avi", num_frames=30)
    opened, frames = read(path)
    assert [f.timestamp_ns for f in frames[:3]] == [0, *(round(k * SECOND_NS / 15) for k in (2, 3))]
    assert (len(frames), opened.num_frames, opened.warnings, opened.is_cut_off) == (
        20,
        20,
        [],
        False,
    )
    opened, _ = read(cut(path))
    assert opened.is_cut_off


def write_avi_with_gaps(path, *, num_frames):
    """One frame in three is missing, so that the file counts more than it holds."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mjpeg", rate=15)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        stream.codec_context.time_base = Fraction(1, 15)
        for k in range(num_frames):
            if k % 3 != 1:
                frame = av.VideoFrame.from_ndarray(noise(k), format="bgr24")
                frame.pts = k
                file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path
