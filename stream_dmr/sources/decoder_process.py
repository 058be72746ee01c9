"""The decoding program, a separate process, since a damaged bitstream can crash the decoder.

    python -P decoder_process.py ADDRESS MEMORY_FD

Each picture goes into a slot of the shared memory, and a line of JSON about it to stdout; the
slot's number comes back as one byte on stdin when the picture is no longer used. The process ends
with stdin. It imports nothing of stream_dmr, so that it starts quickly.

FFmpeg conceals damage, and OpenCV does not report it; but FFmpeg prints it. So FFmpeg prints into a
file in memory, and a line of JSON reports whether errors came.
"""

import ctypes
import json
import mmap
import os
import re
import signal
import sys
import threading
from queue import SimpleQueue

if __name__ == "__main__":  # and not in the process that only imports NUM_SLOTS
    # FFmpeg reads its level once, at its first use in the process.
    os.environ["OPENCV_FFMPEG_LOGLEVEL"] = "40"  # AV_LOG_VERBOSE

import cv2
import numpy as np

# A line of the levels "panic", "fatal" or "error", or H.264's note of concealment, an information.
_ERRORS = re.compile(rb"FFMPEG:(00|08|16)\]|\bconcealing\b")

# OpenCV scales pictures of another size to that of the first. H.264 prints such a change, with the
# size in whole macroblocks; other codecs print none, so that their pictures are squeezed unnoticed.
_SIZES = re.compile(rb"\bReinit context to (\d+)x(\d+)")

NUM_SLOTS = 8  # most of them hold pictures in use


def main(address: str, memory: int) -> None:
    """Decode to the end of the source, or of stdin."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process by closing stdin
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    cv2.setNumThreads(1)
    free: SimpleQueue[int] = SimpleQueue()
    for slot in range(NUM_SLOTS):
        free.put(slot)
    threading.Thread(target=_collect_free_slots, args=(free,), daemon=True).start()
    place = (int(address),) if address.isdecimal() else (address, cv2.CAP_FFMPEG)
    lines, printed = os.dup(1), _Printed()
    capture = cv2.VideoCapture(*place)
    printed.has_errors()  # opening reads some pictures, which are read again
    is_read, image = capture.read()
    if not is_read or image.ndim != 3 or image.dtype != np.uint8:
        return
    os.ftruncate(memory, NUM_SLOTS * image.size)
    shared = mmap.mmap(memory, NUM_SLOTS * image.size)
    slots = np.frombuffer(shared, np.uint8).reshape(NUM_SLOTS, *image.shape)
    _send(
        lines,
        shape=image.shape,
        fps=capture.get(cv2.CAP_PROP_FPS),
        promised=capture.get(cv2.CAP_PROP_FRAME_COUNT),
        before_start=max(0.0, capture.get(cv2.CAP_PROP_PTS)),
        turned_deg=capture.get(cv2.CAP_PROP_ORIENTATION_META),
    )
    slot = free.get()
    np.copyto(slots[slot], image)
    _send(lines, slot=slot, **_facts(capture, printed))
    while capture.grab():
        slot = free.get()  # while a slot is waited for, the next picture is decoded already
        is_read, image = capture.retrieve(slots[slot])
        if not is_read:
            break
        if image.shape != slots[0].shape:
            return _send(lines, resized=image.shape)
        if not np.shares_memory(image, slots[slot]):
            np.copyto(slots[slot], image)
        facts = _facts(capture, printed)
        if printed.resized is not None:
            return _send(lines, resized=printed.resized)
        _send(lines, slot=slot, **facts)
    return _send(lines, end=True, has_errors=printed.has_errors())


class _Printed:
    """Output of C code, kept from stdout."""

    def __init__(self) -> None:
        self._file = os.memfd_create("printed")
        os.dup2(self._file, 1)
        self._flush = ctypes.CDLL(None).fflush
        self._size: tuple[int, int] | None = None  # width and height, px, as they are coded
        self.resized: tuple[int, int] | None = None  # height and width that came instead

    def has_errors(self) -> bool:
        """True if errors were printed since the last call; takes note of a change of size."""
        self._flush(None)
        num_bytes = os.fstat(self._file).st_size
        if not num_bytes:
            return False
        text = os.pread(self._file, num_bytes, 0)
        os.lseek(self._file, 0, os.SEEK_SET)
        os.ftruncate(self._file, 0)
        for found in _SIZES.finditer(text):
            size = int(found[1]), int(found[2])
            if self._size is not None and size != self._size:
                self.resized = size[1], size[0]
            self._size = size
        return _ERRORS.search(text) is not None


def _facts(capture: cv2.VideoCapture, printed: _Printed) -> dict[str, object]:
    milliseconds = capture.get(cv2.CAP_PROP_POS_MSEC)
    return {"milliseconds": milliseconds, "has_errors": printed.has_errors()}


def _collect_free_slots(free: "SimpleQueue[int]") -> None:
    while number := os.read(0, 1):
        free.put(number[0])
    os._exit(0)


def _send(lines: int, **facts: object) -> None:
    os.write(lines, json.dumps(facts).encode() + b"\n")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
