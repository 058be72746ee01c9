"""The camera lost in every way, again and again: how soon frames come, and what grows."""

import itertools
import os
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from benchmarks.reliability.camera_run import resources
from benchmarks.reliability.looped_camera import LoopedCamera
from benchmarks.reliability.small_scene import write_crossing_fish
from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.sources.live_stream import LiveStream
from stream_dmr.sources.source import ReadFramesSettings
from tests.support.camera import Camera

KINDS = ("refused", "reset", "silent", "frozen", "resized")
_SETTINGS = ReadFramesSettings(silence_s=3.0)  # so that a frozen one needn't stay away for 20 s
_LOOP_FRAMES = 30
_LOOP_S = 1.0  # at its own rate of 30 frames/s


def losses(pictures: Path, *, count: int) -> dict[str, object]:
    """Lose the camera `count` times; seconds from its return to the next frame, and growth."""
    camera = Camera("--jpegs", str(pictures), "--fps", "15")
    camera.start()
    watched = Watched(reached(camera.address))
    durations_s: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for number, kind in zip(range(count), itertools.cycle(KINDS), strict=False):
        watched.take(5)
        reconnects = watched.stream.counts.reconnects
        lose(camera, kind)
        back_s = time.monotonic()
        while watched.stream.counts.reconnects == reconnects:
            watched.take(1)
        watched.take(1)
        durations_s[kind].append(time.monotonic() - back_s)
        if number == min(2 * len(KINDS), count - 1):
            watched.begin()
    figures = watched.end()
    camera.lose()
    slowest = {kind: round(max(times), 1) for kind, times in durations_s.items() if times}
    return {"losses": count, "frames again after s, most": slowest} | figures


def restarts(folder: Path, *, count: int) -> dict[str, object]:
    """Let the stream's timestamps begin at 0 again `count` times, with no word of it."""
    folder.mkdir(parents=True)
    write_crossing_fish(folder / "loop.ts", num_frames=_LOOP_FRAMES)
    camera = LoopedCamera(folder / "loop.ts", duration_s=_LOOP_S)
    watched = Watched(reached(camera.address))
    watched.take(5 * _LOOP_FRAMES)
    watched.begin()
    longest_s, before, jumps = 0.0, time.monotonic(), 0
    until = camera.num_loops + count
    while camera.num_loops <= until:
        watched.take(1)
        longest_s = max(longest_s, time.monotonic() - before)
        before, jumps = time.monotonic(), camera.num_loops - until + count
    figures = {
        "timestamps back at 0": jumps - 1,
        "reconnects": watched.stream.counts.reconnects,
        "longest without a frame, s": round(longest_s, 2),
        "capture times off, s, most": round(watched.latest_s, 2),
    }
    figures |= watched.end()
    camera.close()
    return figures


def reached(address: str) -> LiveStream:
    """A stream that has begun; on a busy machine that may take more than one attempt."""
    for _ in range(5):
        with suppress(SourceError):
            return LiveStream(address, _SETTINGS)
    return LiveStream(address, _SETTINGS)


class Watched:
    """A stream whose capture times have to go on, and near the time of arrival."""

    def __init__(self, stream: LiveStream) -> None:
        self.stream = stream
        stream.listen(lambda line: None)
        self._frames: Iterator[Frame] = iter(stream)
        self._last_ns = 0
        self._before: dict[str, float] = {}
        self.latest_s = 0.0  # how far the clock was ahead when a frame was taken

    def take(self, count: int) -> None:
        """Take so many frames."""
        for frame in itertools.islice(self._frames, count):
            assert frame.timestamp_ns > self._last_ns
            self._last_ns = frame.timestamp_ns
            self.latest_s = max(self.latest_s, (time.time_ns() - self._last_ns) / 1e9)

    def begin(self) -> None:
        """All is warm: what is there now is not to grow."""
        self._before = resources(os.getpid())

    def end(self) -> dict[str, object]:
        """Close, and say what grew."""
        after = resources(os.getpid())
        self.stream.close()
        assert self.stream.counts.waiting == 0
        growth = {name: round(after[name] - was, 1) for name, was in self._before.items()}
        return {"growth": growth}


def lose(camera: Camera, kind: str) -> None:
    """Take the camera away for some moments; it is back on return."""
    if kind == "frozen":
        camera.freeze()
        time.sleep(3.5)
        camera.thaw()
        return
    camera.lose()
    if kind == "silent":
        with camera.silent():
            threading.Event().wait(2.0)
    elif kind == "resized":
        camera.start("--size", "160x120")
        time.sleep(4.0)
        camera.lose()
    elif kind == "refused":
        time.sleep(1.5)
    camera.start()
