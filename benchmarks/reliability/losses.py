"""The camera lost in every way, again and again: how soon frames come, and what grows."""

import itertools
import os
import signal
import threading
import time
from pathlib import Path

from measured import Camera, resources

from stream_dmr.live import LiveStream
from stream_dmr.read_settings import ReadFramesSettings

KINDS = ("refused", "reset", "silent", "frozen", "resized")


def losses(pictures: Path, *, count: int) -> dict[str, object]:
    """Lose the camera `count` times; seconds from its return to the next frame, and growth."""
    settings = ReadFramesSettings(silence_s=3.0)  # so that a frozen one needn't stay away for 20 s
    camera = Camera("--jpegs", str(pictures), "--fps", "15")
    camera.start()
    stream = LiveStream(camera.address, settings)
    stream.listen(lambda line: None)
    frames = iter(stream)
    last_ns, took_s, before = 0, [], None
    for number, kind in zip(range(count), itertools.cycle(KINDS), strict=False):
        for frame in itertools.islice(frames, 5):
            assert frame.timestamp_ns > last_ns
            last_ns = frame.timestamp_ns
        reconnects = stream.counts.reconnects
        lose(camera, kind)
        back_s = time.monotonic()
        while stream.counts.reconnects == reconnects:
            next(frames)
        next(frames)
        took_s.append(time.monotonic() - back_s)
        if number == min(len(KINDS), count - 1):
            before = resources(os.getpid())
    after = resources(os.getpid())
    counts = stream.counts
    assert counts.received == counts.passed_on + counts.dropped + counts.failed + stream.num_waiting
    stream.close()
    camera.lose()
    assert before is not None
    growth = {name: round(after[name] - before[name], 1) for name in after}
    return {"losses": count, "frames again after s, most": round(max(took_s), 1), "growth": growth}


def lose(camera: Camera, kind: str) -> None:
    """Take the camera away for some moments; it is back on return."""
    if kind == "frozen":
        process = camera._process
        assert process is not None
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(3.5)
        os.kill(process.pid, signal.SIGCONT)
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
