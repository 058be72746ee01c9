"""The program that decodes: a process of its own, since a broken bitstream can take it down.

    python -P decoder_process.py ADDRESS MEMORY_FD

Pictures go into slots of the shared memory, a line of JSON about each to stdout; the number of a
slot comes back on stdin once its picture was taken. It ends when stdin does. Nothing of ours is
imported here: it has to start quickly.
"""

import json
import mmap
import os
import signal
import sys
import threading
from queue import SimpleQueue

# FFmpeg reads its level once, at its first use in the process.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET

import cv2
import numpy as np

NUM_SLOTS = 3


def main(address: str, memory: int) -> None:
    """Decode to the end of the source, or of stdin."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who started us says when it is over
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    cv2.setNumThreads(1)
    free: SimpleQueue[int] = SimpleQueue()
    for slot in range(NUM_SLOTS):
        free.put(slot)
    threading.Thread(target=_take_back, args=(free,), daemon=True).start()
    capture = _open(address)
    is_read, image = capture.read()
    if not is_read or image.ndim != 3 or image.dtype != np.uint8:
        return
    slots = _share(image.shape, memory)
    _say(
        shape=image.shape,
        fps=capture.get(cv2.CAP_PROP_FPS),
        promised=capture.get(cv2.CAP_PROP_FRAME_COUNT),
    )
    while is_read and image.shape == slots[0].shape:
        milliseconds = capture.get(cv2.CAP_PROP_POS_MSEC)
        slot = free.get()
        np.copyto(slots[slot], image)
        _say(slot=slot, milliseconds=milliseconds)
        is_read, image = capture.read(image)
    _say(resized=image.shape) if is_read else _say(end=True)


def _open(address: str) -> cv2.VideoCapture:
    if address.isdecimal():
        return cv2.VideoCapture(int(address))
    return cv2.VideoCapture(address, cv2.CAP_FFMPEG)


def _share(shape: tuple[int, ...], memory: int) -> np.ndarray:
    size = NUM_SLOTS * int(np.prod(shape))
    os.ftruncate(memory, size)
    return np.frombuffer(mmap.mmap(memory, size), np.uint8).reshape(NUM_SLOTS, *shape)


def _take_back(free: "SimpleQueue[int]") -> None:
    while number := os.read(0, 1):
        free.put(number[0])
    os._exit(0)


def _say(**facts: object) -> None:
    os.write(1, json.dumps(facts).encode() + b"\n")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
