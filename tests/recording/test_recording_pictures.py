"""Pictures in recordings: which of them the run goes on from, and which are for the eye."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stream_dmr.errors import RecordingError, UserError
from stream_dmr.messages import FishCrop, Frame, Message
from stream_dmr.recording.frame_images import RecordedPictures, has_original_pixels
from stream_dmr.recording.mcap.h264_topic import H264Topic, decode_video
from stream_dmr.recording.reading import decoded_messages, open_recordings
from stream_dmr.recording.record import make_record
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import KEY_FRAME_NS, RecordingSettings
from tests.support.reading import read_messages
from tests.support.recorded_run import FRAME_NS, assert_same, header, run

H264 = RecordingSettings(frames="h264", rrd=False)


def frames(count: int, *, width: int = 64, height: int = 48) -> list[Frame]:
    """A bright disc that moves over a rough ground."""
    rng = np.random.default_rng(0)
    noise = cv2.merge([rng.integers(0, 60, (height, width), np.uint8)] * 3)
    made = []
    for index in range(1, count + 1):
        image = cv2.circle(noise.copy(), (index % width, 20), 9, (200, 180, 160), -1)
        time = {"frame_index": index, "timestamp_ns": index * FRAME_NS}
        made.append(Frame(**time, image=image, source="made up"))
    return made


def record(out: Path, given_: list[Message], settings: RecordingSettings) -> list[Message]:
    with Recorder(out, header(), settings) as recorder:
        return [recorder.write(message) for message in given_]


def restored(path: Path, selection: Selection = EVERYTHING) -> Iterator[tuple[Frame, bytes]]:
    opened = open_recordings([path / "recording.mcap"])
    pictures = RecordedPictures(opened, selection)
    for frame, payload in decoded_messages(opened, [Frame], selection):
        assert isinstance(frame, Frame)
        yield pictures.restore(frame, payload), payload


@pytest.mark.parametrize("rrd", [True, False])
@pytest.mark.parametrize("lossy", [{"frames": "jpeg"}, {"crops": "jpeg"}])
def test_what_a_replay_starts_from_is_handed_on_as_it_is_recorded(
    tmp_path: Path, lossy: dict[str, str], rrd: bool
):
    kind = Frame if "frames" in lossy else FishCrop
    made = list(run(2))
    settings = RecordingSettings.model_validate({"rrd": rrd} | lossy)
    handed_on = [m for m in record(tmp_path, made, settings) if isinstance(m, kind)]
    read = read_messages(tmp_path / "recording.mcap", [kind])
    for one, other in zip(handed_on, read, strict=True):
        assert_same(one, other)
    original = next(message for message in made if isinstance(message, kind))
    assert original.image is not None
    assert handed_on[0].image is not None
    assert (handed_on[0].image != original.image).any()


@pytest.mark.parametrize("changes", [{"frames": "jpeg", "crops": "png"}, {"frames": "h264"}])
def test_pictures_for_the_eye_are_not_what_the_run_goes_on_from(
    tmp_path: Path, changes: dict[str, str]
):
    made = frames(5)
    settings = RecordingSettings.model_validate({"rrd": False} | changes)
    for one, other in zip(record(tmp_path, [*made], settings), made, strict=True):
        assert_same(one, other)
    for (frame, payload), original in zip(restored(tmp_path), made, strict=True):
        assert not has_original_pixels(frame, payload)
        assert has_original_pixels(original, payload)
        assert cv2.PSNR(frame.image, original.image) > 25


def test_a_picture_in_the_middle_of_the_video_is_found(tmp_path: Path):
    made = frames(90)
    record(tmp_path, [*made], H264.model_copy(update={"flush_s": 1e-9}))  # many small chunks
    wanted = made[50:53]
    selection = Selection(time_ns=(wanted[0].timestamp_ns, wanted[-1].timestamp_ns + 1))
    opened = open_recordings([tmp_path])
    assert 30 < len(list(opened.video(replace(selection, lead_ns=KEY_FRAME_NS)))) < 40
    for (frame, _), original in zip(restored(tmp_path, selection), wanted, strict=True):
        assert cv2.PSNR(frame.image, original.image) > 25


sizes = st.integers(16, 40)


@given(arrays(np.uint8, st.tuples(sizes, sizes, st.just(3))))
def test_video_takes_any_size(image: np.ndarray):
    topic = H264Topic(crf=1)
    times = [FRAME_NS, 2 * FRAME_NS]
    given_ = [Frame(frame_index=1, timestamp_ns=t, image=image, source="") for t in times]
    samples = [
        video.SerializeToString()
        for frame in given_
        for _, video in topic.draw(make_record(frame, H264))
    ]
    decoded = list(decode_video(samples))
    assert [time for time, _ in decoded] == times
    height, width = image.shape[:2]
    for _, picture in decoded:
        assert picture.shape == (height + height % 2, width + width % 2, 3)
        # Colours have half the resolution, brightness has all of it.
        grey = cv2.cvtColor(picture[:height, :width], cv2.COLOR_BGR2GRAY).astype(int)
        assert np.abs(grey - cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)).mean() < 20


@given(st.integers(0, 10**6), st.integers(1, 255))
def test_damaged_video_is_refused_or_decoded_but_never_crashes(position: int, flip: int):
    topic = H264Topic(crf=20)
    records = [make_record(frame, H264) for frame in frames(3)]
    samples = [video.SerializeToString() for r in records for _, video in topic.draw(r)]
    damaged = bytearray(samples[1])
    damaged[position % len(damaged)] ^= flip
    try:
        assert len(list(decode_video([samples[0], bytes(damaged), samples[2]]))) <= 3
    except RecordingError as error:
        assert "H.264" in str(error)  # noqa: PT017


def test_without_ffmpeg_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    record(tmp_path, [*frames(2)], H264)
    monkeypatch.delitem(sys.modules, "stream_dmr.recording.mcap.h264_topic")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UserError, match=r"pip install 'stream-dmr\[h264\]'"):
        Recorder(tmp_path / "b", header(), H264)
    with pytest.raises(UserError, match=r"pip install 'stream-dmr\[h264\]'"):
        list(restored(tmp_path))
