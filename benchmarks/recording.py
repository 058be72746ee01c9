"""What recording costs, in MB a minute at 30 frames/s and ms a frame, with two fish.

    python benchmarks/recording.py [VIDEO]

The fish are made up; the pictures are VIDEO's where one is given, scaled to 1280 x 960, since
sensor noise decides their size.
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from recorded_run import HEIGHT, WIDTH, header, run

from stream_dmr.camera import frame_from_crop
from stream_dmr.messages import FishCrop, Frame, Message
from stream_dmr.recording.recorder import Recorder
from stream_dmr.recording.settings import RecordingSettings

NUM_FRAMES = 90
MB_PER_MINUTE = 1e-6 * 60 * 30 / NUM_FRAMES
BARE = {"mcap": True, "rrd": False, "frames": "reference", "crops": "jpeg"}
CASES = {
    ".mcap, frames by reference, crops JPEG": BARE,
    ".mcap, frames by reference, crops PNG": BARE | {"crops": "png"},
    ".mcap, frames JPEG, crops PNG (default)": BARE | {"frames": "jpeg", "crops": "png"},
    ".rrd, without messages": BARE | {"mcap": False, "rrd": True, "rrd_messages": False},
    "both, frames JPEG, crops PNG, .rrd with messages (default)": {},
}


def main() -> None:
    video = sys.argv[1] if len(sys.argv) > 1 else None
    messages = list(run(NUM_FRAMES))
    if video is not None:
        messages = list(_with_pictures(messages, video))
    print("| what | MB/min | ms/frame |\n|---|---|---|")
    for name, changes in CASES.items():
        size, elapsed = _measure(messages, RecordingSettings(**changes))
        print(f"| {name} | {size * MB_PER_MINUTE:.0f} | {1e3 * elapsed / NUM_FRAMES:.1f} |")


def _measure(messages: list[Message], settings: RecordingSettings) -> tuple[int, float]:
    """Bytes on disk and seconds spent, closing included."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        with Recorder(Path(folder), header(), settings) as recorder:
            for message in messages:
                recorder.write(message)
        elapsed = time.perf_counter() - start
        return sum(file.stat().st_size for file in Path(folder).iterdir()), elapsed


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
