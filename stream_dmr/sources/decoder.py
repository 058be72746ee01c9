"""Decoding in a process of its own: what breaks the decoder doesn't break the measurement."""

import json
import mmap
import os
import select
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import UInt8

from stream_dmr.sources.decoder_process import NUM_SLOTS

_PROGRAM = Path(__file__).with_name("decoder_process.py")


class DecodingError(Exception):
    """The decoder gives no more pictures; the message says why, for people."""


class ResizedError(DecodingError):
    """The next picture has another size: `width` x `height` px."""

    def __init__(self, *, width: int, height: int) -> None:
        super().__init__(f"pictures of {width}x{height} px came")
        self.width, self.height = width, height


@dataclass(frozen=True, eq=False, kw_only=True)
class DecodedPicture:
    """One decoded picture, with the time in ms that the container or stream gives it."""

    milliseconds: float
    image: UInt8[np.ndarray, "H W 3"]  # BGR


class Decoder:
    """Pictures of one video, stream or camera, in order; memory is shared with the process."""

    def __init__(self, address: str) -> None:
        """Start decoding a path, an address or a camera's index; the first `read` tells of it."""
        self.width = self.height = 0  # px, known after the first picture, as are these:
        self.fps = 0.0  # as the container says; 0, NaN or nonsense where it doesn't
        self.promised = 0.0  # frames, likewise
        self._reading = Lock()
        self._slots: np.ndarray | None = None
        self._text = b""
        self._memory = os.memfd_create("pictures")  # nameless: nothing is left after a crash
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(_PROGRAM), address, str(self._memory)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            pass_fds=[self._memory],
            start_new_session=True,  # Ctrl-C is for us alone
        )

    def read(self, *, timeout_s: float) -> DecodedPicture | None:
        """Wait for the next picture; None at the end.

        Raises DecodingError where none comes for `timeout_s`, where the process has died, or
        (ResizedError) where the next picture has another size.
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
            self._text, self._slots = b"", None

    def _read(self, timeout_s: float) -> DecodedPicture | None:
        until = time.monotonic() + timeout_s
        while (said := self._hear(until)) is not None:
            if "shape" in said:
                self._begin(said)
            elif "resized" in said:
                height, width = said["resized"][:2]
                raise ResizedError(width=width, height=height)
            elif "slot" in said:
                return self._take(said)
            else:
                return None
        if self._slots is None:
            return None  # it could not be opened, holds no picture, or was closed
        status = self._process.wait()
        raise DecodingError(f"the decoder broke down (status {status})")

    def _begin(self, said: dict[str, Any]) -> None:
        self.height, self.width = said["shape"][:2]
        self.fps, self.promised = said["fps"], said["promised"]
        size = NUM_SLOTS * self.height * self.width * 3
        shared = mmap.mmap(self._memory, size)
        self._slots = np.frombuffer(shared, np.uint8).reshape(-1, self.height, self.width, 3)

    def _take(self, said: dict[str, Any]) -> DecodedPicture:
        assert self._slots is not None
        assert self._process.stdin is not None
        image = self._slots[said["slot"]].copy()
        with suppress(BrokenPipeError):  # it died since; the next read says so
            self._process.stdin.write(bytes([said["slot"]]))
        return DecodedPicture(milliseconds=said["milliseconds"], image=image)

    def _hear(self, until: float) -> dict[str, Any] | None:
        """The next line; None where the process has ended."""
        assert self._process.stdout is not None
        while b"\n" not in self._text:
            if self._process.stdout.closed:
                return None
            patience_s = max(0.0, until - time.monotonic())
            if not select.select([self._process.stdout], [], [], patience_s)[0]:
                raise DecodingError("no picture came for too long")
            data = os.read(self._process.stdout.fileno(), 1 << 16)
            if not data:
                return None
            self._text += data
        line, _, self._text = self._text.partition(b"\n")
        return json.loads(line)
