"""Decoding in a child process: a crash of the decoder does not end the measurement."""

import json
import mmap
import os
import select
import subprocess
import sys
import time
import weakref
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import UInt8

from stream_dmr.sources.decoder_process import NUM_SLOTS

# To pictures in use, without three slots: one is written, another waits, the third is read.
_LENT_SLOTS = NUM_SLOTS - 3
_PROGRAM = Path(__file__).with_name("decoder_process.py")


class DecodingError(Exception):
    """The decoder returns no more pictures; the message has the reason."""


class LateError(DecodingError):
    """No picture came in time."""


class ResizedError(DecodingError):
    """The next picture has another size than the first: `width` x `height` px."""

    def __init__(self, *, width: int, height: int) -> None:
        super().__init__(f"pictures of {width}x{height} px came")
        self.width, self.height = width, height


@dataclass(frozen=True, eq=False, kw_only=True)
class DecodedPicture:
    """One decoded picture."""

    milliseconds: float  # timestamp of the container or stream, from OpenCV
    image: UInt8[np.ndarray, "H W 3"]  # BGR


class Decoder:
    """Pictures of one video, stream or camera, in order, from a child process.

    Pictures come through shared memory, messages about them as lines of JSON through a pipe; see
    `decoder_process`.
    """

    def __init__(self, address: str) -> None:
        """Start decoding a path, an address or a camera's index; errors come with `read`."""
        self.width = self.height = 0  # px, known after the first picture, as are these:
        self.fps = 0.0  # of the container; 0, NaN or impossible if it has none
        self.promised = 0.0  # number of frames, likewise
        self.before_start = 0.0  # frames, by the container's clock, before the first picture
        self.turned_deg = 0.0  # by which the container asks for a turn, which OpenCV has made
        self.num_errors = 0  # pictures, and the end, before which FFmpeg reported errors
        self._reading = Lock()
        self._shared: memoryview | None = None  # all slots
        self._num_lent = 0  # slots that pictures in use lie in
        self._unused = SimpleQueue[int]()  # slots of pictures no longer used, not yet sent back
        self._received = b""  # of the pipe, not yet a whole line
        self._memory = os.memfd_create("pictures")  # nameless: nothing is left after a crash
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(_PROGRAM), address, str(self._memory)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            pass_fds=[self._memory],
            start_new_session=True,  # Ctrl-C must not reach the decoder
        )

    def read(self, *, timeout_s: float) -> DecodedPicture | None:
        """Wait for the next picture; None at the end.

        Raises LateError if none comes for `timeout_s`, DecodingError if the process has died, and
        ResizedError if the next picture has another size.
        """
        with self._reading:
            return self._read(timeout_s)

    def close(self) -> None:
        """End the process. Idempotent; a `read` in another thread ends."""
        self._process.kill()
        self._process.wait()
        with self._reading:
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()
            if self._memory >= 0:
                os.close(self._memory)
                self._memory = -1
            self._received, self._shared = b"", None

    def _read(self, timeout_s: float) -> DecodedPicture | None:
        deadline_s = time.monotonic() + timeout_s
        self._return_unused()
        while (message := self._receive(deadline_s)) is not None:
            self.num_errors += message.get("has_errors", False)
            if "shape" in message:
                self.height, self.width = message["shape"][:2]
                self.fps, self.promised = message["fps"], message["promised"]
                self.before_start = message["before_start"]
                self.turned_deg = message["turned_deg"]
                size = NUM_SLOTS * self.height * self.width * 3
                self._shared = memoryview(mmap.mmap(self._memory, size))
            elif "resized" in message:
                height, width = message["resized"][:2]
                raise ResizedError(width=width, height=height)
            elif "slot" in message:
                image = self._picture(message["slot"])
                return DecodedPicture(milliseconds=message["milliseconds"], image=image)
            else:
                return None
        if self._shared is None:
            return None  # it could not be opened, holds no picture, or was closed
        status = self._process.wait()
        raise DecodingError(f"the decoder crashed (status {status})")

    def _picture(self, slot: int) -> UInt8[np.ndarray, "H W 3"]:
        """The picture of a slot, which is unused when nothing refers to it, or to its parts.

        It is a copy if many pictures are in use, since the child must not wait for them.
        """
        assert self._shared is not None
        size = self.height * self.width * 3
        pixels = np.frombuffer(self._shared[slot * size : (slot + 1) * size], np.uint8)
        if self._num_lent < _LENT_SLOTS:
            # Views of views have this array as their base, so it lives as long as any of them.
            weakref.finalize(pixels, self._unused.put, slot).atexit = False
        else:
            pixels = pixels.copy()
            self._unused.put(slot)
        self._num_lent += 1
        return pixels.reshape(self.height, self.width, 3)

    def _return_unused(self) -> None:
        """Tell the child which slots are free: here, since a picture may go in any thread."""
        assert self._process.stdin is not None
        while not self._unused.empty():
            self._num_lent -= 1
            with suppress(BrokenPipeError, ValueError):  # the child has died, or this was closed
                self._process.stdin.write(bytes([self._unused.get()]))

    def _receive(self, deadline_s: float) -> dict[str, Any] | None:
        """The child's next message; None if it has ended. Raises LateError."""
        assert self._process.stdout is not None
        while b"\n" not in self._received:
            if self._process.stdout.closed:
                return None
            timeout_s = max(0.0, deadline_s - time.monotonic())
            if not select.select([self._process.stdout], [], [], timeout_s)[0]:
                raise LateError("no picture came for too long")
            data = os.read(self._process.stdout.fileno(), 1 << 16)
            if not data:
                return None
            self._received += data
        line, _, self._received = self._received.partition(b"\n")
        return json.loads(line)


_ahead: dict[str, Decoder] = {}  # by address: not yet asked for


@contextmanager
def decoding_ahead(path: Path) -> Generator[None]:
    """Begin to decode a video file; the next `open_decoder` of it inside takes over that process.

    A process and its first picture take half a second, in which this process imports the rest.
    """
    address = _address_of(path)
    _ahead[address] = Decoder(address)
    try:
        yield
    finally:
        if (left := _ahead.pop(address, None)) is not None:
            left.close()


def open_decoder(path: Path) -> Decoder:
    """The decoder of a video file, from its first picture."""
    address = _address_of(path)
    return _ahead.pop(address, None) or Decoder(address)


def _address_of(path: Path) -> str:
    """The absolute path: FFmpeg takes text before a colon in a relative path for a protocol."""
    return str(path.resolve())
