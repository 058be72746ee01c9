"""What recording costs, in MB a minute at 30 frames/s and ms a frame, with two fish.

    python -m benchmarks.recording.recording_cost [VIDEO]

The fish are made up; the pictures are VIDEO's where one is given, scaled to 1280 x 960, since
sensor noise decides their size. Frames come at 30 a second, as from a camera.
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from stream_dmr.camera import frame_from_crop
from stream_dmr.messages import FishCrop, Frame, Message
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.store.run_tables import FramesTable
from tests.support.recorded_run import HEIGHT, WIDTH, header, run

NUM_FRAMES, RATE_HZ = 90, 30
EXACT = {"crops": "png", "meshes": "vertices"}
DRAWN = EXACT | {"view_rate_hz": 1000.0}
CASES = {
    ".mcap only": {"rrd": False},
    "the default: .mcap, and .rrd with the messages": {},
    "and frames as H.264": {"frames": "h264"},
    "or frames as JPEG, from which crops are made again": {"frames": "jpeg"},
    "or crops as JPEG": {"crops": "jpeg"},
    "or crops as PNG": {"crops": "png"},
    "crops as PNG, vertices and covariance": EXACT,
    "and every frame drawn": DRAWN,
    "and frames as H.264: everything": DRAWN | {"frames": "h264"},
    "or frames as JPEG: everything": DRAWN | {"frames": "jpeg"},
}


class Cost(NamedTuple):
    """Of one run; times in s."""

    size: int  # bytes on disk
    wait: float  # that the measuring threads spend in `write`
    cpu: float  # of the process, closing included


def main() -> None:
    video = sys.argv[1] if len(sys.argv) > 1 else None
    messages = list(run(NUM_FRAMES))
    if video is not None:
        messages = list(_with_pictures(messages, video))
    _measure(messages[:50], RecordingSettings())  # what happens once, happens here
    print("| what | MB/min | measuring waits, ms/frame | CPU in all, ms/frame |")
    print("|---|---|---|---|")
    for name, changes in CASES.items():
        cost = _measure(messages, RecordingSettings(**changes))
        megabytes = 1e-6 * cost.size * 60 * RATE_HZ / NUM_FRAMES
        wait, cpu = 1e3 * cost.wait / NUM_FRAMES, 1e3 * cost.cpu / NUM_FRAMES
        print(f"| {name} | {megabytes:.0f} | {wait:.1f} | {cpu:.1f} |")


def _measure(messages: list[Message], settings: RecordingSettings) -> Cost:
    with tempfile.TemporaryDirectory() as folder:
        wait, start, cpu = 0.0, time.perf_counter(), time.process_time()
        frames = FramesTable(Path(folder))
        with Recorder(Path(folder), header(), settings, sinks=[frames]) as recorder:
            for message in messages:
                if isinstance(message, Frame):
                    due = start + message.frame_index / RATE_HZ
                    time.sleep(max(0.0, due - time.perf_counter()))
                began = time.perf_counter()
                recorder.write(message)
                wait += time.perf_counter() - began
        cpu = time.process_time() - cpu
        return Cost(sum(file.stat().st_size for file in Path(folder).iterdir()), wait, cpu)


def _with_pictures(messages: list[Message], video: str) -> Iterator[Message]:
    """The same messages with the video's pictures, cut where the fish are."""
    capture, image = cv2.VideoCapture(video), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for message in messages:
        if isinstance(message, Frame):
            ok, picture = capture.read()
            image = cv2.resize(picture, (WIDTH, HEIGHT)) if ok else image
            message = replace(message, image=image)
        elif isinstance(message, FishCrop):
            message = replace(message, image=_cut(image, message))
        yield message


def _cut(image: np.ndarray, crop: FishCrop) -> np.ndarray:
    size = crop.crop_camera.width
    pixels = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2)
    cameras = {"crop_camera": crop.crop_camera, "frame_camera": crop.frame_camera}
    source = frame_from_crop(pixels.astype(float), **cameras).astype(np.float32)
    x, y = source.reshape(size, size, 2).transpose(2, 0, 1)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)


if __name__ == "__main__":
    main()
