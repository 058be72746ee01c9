"""Live sources: a real RTSP server on loopback, lost in every way; decoders that break down."""

import contextlib
import itertools
import os
import signal
import statistics
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.errors import SourceError
from stream_dmr.files import without_password
from stream_dmr.messages import Frame
from stream_dmr.sources.decoder import Decoder, DecodingError, decoding_ahead
from stream_dmr.sources.decoder_process import NUM_SLOTS
from stream_dmr.sources.live_stream import LiveStream
from stream_dmr.sources.source import ReadFramesSettings, ResumePoint
from stream_dmr.sources.video_file import VideoFile
from tests.support.camera import Camera, camera, require_server

QUICK = ReadFramesSettings(silence_s=1.5, connect_s=20.0, retry_s=0.5)
PATIENCE_S = 60.0  # for what comes within a second, unless the machine is busy
NUM_PICTURES = 32
BURST = 30  # on connecting, FFmpeg looks through a second of the stream, then hands it out at once


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A loop of grey pictures, each brighter than the one before."""
    require_server()
    folder = tmp_path_factory.mktemp("pictures")
    for k in range(NUM_PICTURES):
        cv2.imwrite(str(folder / f"{k:03d}.jpg"), np.full((48, 64, 3), 8 * k, np.uint8))
    return folder


@pytest.fixture
def rail(pictures: Path) -> Iterator[Camera]:
    with camera("--jpegs", str(pictures), "--fps", "25") as served:
        yield served


def take(frames: Iterator[Frame], count: int) -> list[Frame]:
    return list(itertools.islice(frames, count))


def number_of(frame: Frame) -> int:
    """Which picture of the loop it is."""
    return round(float(frame.image.mean()) / 8)


def assert_every_frame_is_counted(stream: LiveStream) -> None:
    """Once closed, every frame that was received was passed on, dropped or failed."""
    counts = stream.counts
    assert counts.received == counts.passed_on + counts.dropped + counts.failed


def test_an_rtsp_stream_gives_its_pictures_in_order_at_their_times(rail: Camera):
    stream = LiveStream(rail.address, QUICK)
    frames = take(iter(stream), BURST + 30)
    stream.close()
    assert (stream.width, stream.height, stream.is_endless) == (64, 48, True)
    assert [frame.frame_index for frame in frames] == list(range(1, BURST + 31))
    pairs = list(itertools.pairwise(frames[BURST:]))
    steps = [(number_of(b) - number_of(a)) % NUM_PICTURES for a, b in pairs]
    assert min(steps) >= 1
    off = [
        (b.timestamp_ns - a.timestamp_ns) / 40e6 - n for (a, b), n in zip(pairs, steps, strict=True)
    ]
    assert abs(statistics.median(off)) < 0.9  # single pictures are late on a busy machine
    assert_every_frame_is_counted(stream)


def test_h264_with_its_password_out_of_the_name():
    require_server()
    with camera("--size", "160x120") as rail:
        stream = LiveStream(rail.address.replace("//", "//mate:secret@"), QUICK)
        (frame,) = take(iter(stream), 1)
        stream.close()
    assert frame.image.shape == (120, 160, 3)
    assert frame.source == stream.name == rail.address


@pytest.mark.parametrize("loss", ["refused", "silent", "resized", "frozen"])
def test_a_lost_camera_is_found_again(rail: Camera, pictures: Path, loss: str):
    notices: list[str] = []
    is_lost, is_resized = threading.Event(), threading.Event()

    def listen(line: str) -> None:
        notices.append(line)
        for said, event in (("is lost", is_lost), ("no longer are 64x48", is_resized)):
            if said in line:
                event.set()

    stream = LiveStream(rail.address, QUICK)
    stream.listen(listen)
    frames = iter(stream)
    before = take(frames, 5)
    if loss == "frozen":
        rail.freeze()
        assert is_lost.wait(PATIENCE_S)
        rail.thaw()
    else:
        rail.lose()
        assert is_lost.wait(PATIENCE_S)
    if loss == "silent":
        with rail.silent() as server:
            connection, _ = server.accept()
            connection.close()
    if loss == "resized":
        rail.start("--size", "160x120")
        assert is_resized.wait(PATIENCE_S)
        rail.lose()
    if loss != "frozen":
        rail.start()
    while stream.counts.reconnects == 0:
        take(frames, 1)
    after = take(frames, 5)
    stream.close()
    assert any("is lost" in line for line in notices)
    times = [frame.timestamp_ns for frame in (*before, *after)]
    assert all(a < b for a, b in itertools.pairwise(times))
    assert after[0].image.shape == (48, 64, 3)
    assert stream.counts.failed == (1 if loss == "resized" else 0) or stream.counts.failed > 1
    assert_every_frame_is_counted(stream)


def test_what_the_chain_has_no_time_for_is_dropped_oldest_first(rail: Camera):
    stream = LiveStream(rail.address, QUICK)
    frames = iter(stream)
    first = take(frames, BURST)[-1]
    dropped = stream.counts.dropped
    while stream.counts.dropped < dropped + 10:
        time.sleep(0.05)
    waited = take(frames, QUICK.live_queue)
    stream.close()
    assert waited[0].frame_index == first.frame_index + 1
    assert (waited[0].timestamp_ns - first.timestamp_ns) / 40e6 >= 10  # the newest were kept
    assert_every_frame_is_counted(stream)


def test_capture_times_go_on_after_an_earlier_run(rail: Camera):
    stream = LiveStream(rail.address, QUICK)
    stream.resume(ResumePoint(after_ns=2**62))
    frames = take(iter(stream), 2)
    stream.close()
    assert frames[0].timestamp_ns > 2**62


def test_closing_wakes_who_waits(rail: Camera):
    stream = LiveStream(rail.address, QUICK)
    frames = iter(stream)
    take(frames, 1)
    rail.lose()
    threading.Timer(0.3, stream.close).start()
    assert take(frames, 1000) is not None  # comes to an end
    stream.close()  # waits until the other thread is through
    assert_every_frame_is_counted(stream)


def test_a_stored_video_at_an_address_is_read_whole_and_once(tmp_path: Path):
    path = write_video(tmp_path / "a.avi", num_frames=40)
    stream = LiveStream(f"file://{path}", QUICK)
    frames = []
    for frame in stream:
        frames.append(frame)
        time.sleep(0.005)  # slower than the decoder
    stream.close()
    assert [frame.frame_index for frame in frames] == list(range(1, 41))
    assert stream.counts.dropped == 0
    assert not stream.is_endless
    assert_every_frame_is_counted(stream)


def write_video(path: Path, *, num_frames: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    for k in range(num_frames):
        writer.write(np.full((48, 64, 3), k, np.uint8))
    writer.release()
    return path


def children() -> set[int]:
    """The processes that this one has started."""
    found = set[int]()
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread that ended
            found |= {int(pid) for pid in (task / "children").read_text().split()}
    return found


def test_a_decoder_that_breaks_down_ends_a_file_with_a_warning(tmp_path: Path):
    before = children()
    video = VideoFile(write_video(tmp_path / "a.avi", num_frames=40), ReadFramesSettings())
    (decoder,) = children() - before
    frames = []
    for frame in video:
        frames.append(frame)
        if frame.frame_index == 3:
            os.kill(decoder, signal.SIGKILL)
    assert 3 <= len(frames) < 12  # what was decoded before
    assert "a.avi: the decoder crashed (status -9) after frame" in video.warnings[0]


def test_a_decoder_that_hangs_is_given_up(tmp_path: Path):
    before = children()
    decoder = Decoder(str(write_video(tmp_path / "a.avi", num_frames=40)))
    assert decoder.read(timeout_s=10.0) is not None
    (process,) = children() - before
    os.kill(process, signal.SIGSTOP)
    for _ in range(NUM_SLOTS):  # what it had decoded by then
        with contextlib.suppress(DecodingError):
            decoder.read(timeout_s=0.2)
    with pytest.raises(DecodingError, match="no picture came for too long"):
        decoder.read(timeout_s=0.2)
    decoder.close()
    decoder.close()


def test_a_decoder_takes_nothing_with_it_and_leaves_nothing(tmp_path: Path):
    path = write_video(tmp_path / "a.avi", num_frames=4)
    before = set(os.listdir("/proc/self/fd"))
    for _ in range(3):
        decoder = Decoder(str(path))
        assert decoder.read(timeout_s=10.0) is not None
        decoder.close()
        assert decoder.read(timeout_s=10.0) is None
    assert set(os.listdir("/proc/self/fd")) == before


def test_an_address_where_nothing_is_is_refused():
    with pytest.raises(SourceError, match=r"rtsp://127\.0\.0\.1:9/rail: expected"):
        LiveStream("rtsp://mate:secret@127.0.0.1:9/rail", QUICK)


def test_a_decoder_takes_over_what_was_started_ahead(tmp_path: Path):
    path = write_video(tmp_path / "a.avi", num_frames=3)
    before = children()
    with decoding_ahead(path):
        ahead = children() - before
        assert len(ahead) == 1
        with contextlib.closing(VideoFile(path, ReadFramesSettings())) as video:
            assert children() - before == ahead
            assert len(list(video)) == 3
    assert children() == before


def test_a_decoder_that_nobody_takes_over_is_ended(tmp_path: Path):
    path = write_video(tmp_path / "a.avi", num_frames=3)
    before = children()
    with decoding_ahead(path):
        assert len(children() - before) == 1
    assert children() == before


@pytest.mark.parametrize(
    "address",
    [
        "rtsp://mate:geheim@10.0.0.7/s1",
        "rtsp://10.0.0.7/user=mate&password=geheim&channel=1",
        "rtsp://10.0.0.7/user=mate_password=geheim_channel=1",
        "http://10.0.0.7/video.cgi?user=mate&pwd=geheim",
        "https://10.0.0.7/v.m3u8?token=geheim",
    ],
)
def test_no_password_is_left_in_an_address(address):
    shown = without_password(f"stream-dmr run --source '{address}' --out user=x")
    assert "geheim" not in shown
    assert shown.startswith(f"stream-dmr run --source '{address.split('/')[0]}//")
    assert shown.endswith("' --out user=x")
