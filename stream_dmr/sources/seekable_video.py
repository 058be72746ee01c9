"""Single pictures of a video file by their capture time, without reading all before them."""

import math
import os
from pathlib import Path
from threading import Lock

# FFmpeg reads its level once, at its first use in the process.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET

import cv2
import numpy as np
from jaxtyping import UInt8

_LEAD_MS = 200.0  # containers round their times: a search begins a little earlier
_AHEAD_MS = 2000.0  # reading on to a later picture is quicker than a new search up to here; chosen
_MAX_TOLERANCE_MS = 20.0  # a picture's time is the same whenever it is read, but for rounding


class SeekableVideo:
    """Pictures of a video that a run has read before, in any order. Thread-safe.

    It decodes in this process: a file that a run has read to its end does not crash the decoder.
    """

    def __init__(self, path: Path) -> None:
        self._capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        # Half a frame; of a film with pauses the rate, which is a mean of all, says nothing.
        half_ms = 500.0 / fps if 1e-3 < fps < 1e6 else 1.0
        self._tolerance_ms = min(half_ms, _MAX_TOLERANCE_MS)
        self._next_ms = 0.0  # of the picture that a read would give, about
        self._lock = Lock()

    def image_at(self, timestamp_ns: int) -> UInt8[np.ndarray, "H W 3"] | None:
        """The picture of a capture time as BGR; None where the video has none then."""
        wanted_ms = timestamp_ns / 1e6
        with self._lock:
            if not self._next_ms - self._tolerance_ms <= wanted_ms <= self._next_ms + _AHEAD_MS:
                at_ms = self._seek(wanted_ms - _LEAD_MS)
                if at_ms > wanted_ms + self._tolerance_ms:  # FFmpeg searches by the mean rate
                    at_ms = self._seek(0.0)
            else:
                at_ms = self._grab()
            while at_ms <= wanted_ms + self._tolerance_ms:
                if at_ms > wanted_ms - self._tolerance_ms:
                    is_read, image = self._capture.retrieve()
                    return image if is_read and image.ndim == 3 else None
                at_ms = self._grab()
            return None

    def _seek(self, time_ms: float) -> float:
        """Search, and take the next picture; its time."""
        self._capture.set(cv2.CAP_PROP_POS_MSEC, max(0.0, time_ms))
        return self._grab()

    def _grab(self) -> float:
        """Take the next picture; its time in ms, infinite at the end, after which is searched."""
        if not self._capture.grab():
            self._next_ms = math.inf
            return math.inf
        at_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        self._next_ms = at_ms + 2 * self._tolerance_ms
        return at_ms

    def close(self) -> None:
        """Release the file."""
        with self._lock:
            self._capture.release()
