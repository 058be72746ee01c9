"""Sources of frames: a video file, a folder of pictures, a camera or a network stream."""

import math
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.pictures import PictureFolder, check_size, nominal_ns
from stream_dmr.settings import Settings

# OpenCV and FFmpeg on stderr would bury our one clear line. FFmpeg's level is read once, at its
# first use in the process, so it must be set here.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

_NONSENSE_MS = 1e12  # 31 years
_TEXT = bytes(range(32, 127)) + b"\t\r\n"


class ReadFramesSettings(Settings):
    """`[read_frames]`: how a source is read."""

    images_fps: float = Field(
        default=30.0,
        gt=0,
        allow_inf_nan=False,
        description="frames/s of folders of pictures and of videos without timestamps",
    )


@runtime_checkable
class Source(Protocol):
    """Frames in order, once; `frame_index` from 1, `timestamp_ns` strictly increasing."""

    name: str  # file name or address, for people
    width: int  # px, of every frame
    height: int
    num_frames: int | None  # as the source promises; None where it doesn't
    fps: float
    warnings: list[str]  # what was wrong but could be read on, a line each; complete at the end

    def __iter__(self) -> Iterator[Frame]:
        """Raises SourceError where a frame doesn't fit those before it."""
        ...

    def close(self) -> None:
        """Let go of the file or device; iteration ends."""
        ...


def open_source(source: str, settings: ReadFramesSettings) -> Source:
    """A source by its path, address (`rtsp://...`) or camera index, with its first frame read.

    Raises SourceError with one line where nothing can be read from it.
    """
    path = Path(source)
    if path.is_dir():
        return PictureFolder(path, fps=settings.images_fps)
    if path.is_file():
        return VideoFile(path, settings)
    if source.isdecimal() or "://" in source:
        return LiveStream(source, settings)
    raise SourceError(
        f"{source}: expected a video, a folder of pictures, an address such as rtsp://... "
        "or a camera index, found no such file; check the path"
    )


class VideoFile:
    """A video file; a damaged one gives the frames that still decode, and a warning."""

    def __init__(self, path: Path, settings: ReadFramesSettings) -> None:
        self.name = path.name
        self.warnings: list[str] = []
        start = _start_of(path)
        # Absolute, since FFmpeg takes what stands before a colon in a relative path for a protocol.
        self._capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
        self._first = _read(self._capture)
        if self._first is None:
            raise SourceError(f"{path}: {_why_unreadable(path, start)}")
        self.height, self.width = self._first[1].shape[:2]
        promised = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.num_frames = int(promised) if promised >= 1 else None
        self.fps = _fps_of(self._capture, settings)

    def __iter__(self) -> Iterator[Frame]:
        frame_index, timestamp_ns = 0, -1
        pending, self._first = self._first, None
        while pending is not None:
            milliseconds, image = pending
            frame_index += 1
            check_size(
                image,
                width=self.width,
                height=self.height,
                where=f"{self.name}, frame {frame_index}",
            )
            timestamp_ns = container_ns(
                milliseconds, frame_index=frame_index, fps=self.fps, previous_ns=timestamp_ns
            )
            yield Frame(
                frame_index=frame_index,
                timestamp_ns=timestamp_ns,
                image=image,
                source=self.name,
            )
            pending = _read(self._capture)
        self._compare_with_promise(frame_index)
        self.close()

    def close(self) -> None:
        """Let go of the file; iteration ends."""
        self._first = None
        self._capture.release()

    def _compare_with_promise(self, num_read: int) -> None:
        # Containers without a frame count promise duration x rate, which may be one too many.
        if self._capture.isOpened() and self.num_frames and num_read < self.num_frames - 1:
            self.warnings.append(
                f"{self.name}: the file promises {self.num_frames} frames, only {num_read} could "
                "be read; it seems cut off or damaged"
            )


class LiveStream:
    """A camera by its index or a network stream; timestamps are the clock's at arrival."""

    def __init__(self, address: str, settings: ReadFramesSettings) -> None:
        self.name = re.sub(r"(?<=://)[^/]*@", "", address)  # names are recorded; passwords not
        self.warnings: list[str] = []
        if address.isdecimal():
            self._capture = cv2.VideoCapture(int(address))
            self.name = f"camera {address}"
        else:
            self._capture = cv2.VideoCapture(address, cv2.CAP_FFMPEG)
        first = _read(self._capture)
        if first is None:
            raise SourceError(
                f"{self.name}: expected a camera or stream that gives pictures, got none; "
                "check that it is switched on and reachable"
            )
        self.height, self.width = first[1].shape[:2]
        self.num_frames: int | None = None
        self.fps = _fps_of(self._capture, settings)

    def __iter__(self) -> Iterator[Frame]:
        frame_index, timestamp_ns = 0, -1
        while (read := _read(self._capture)) is not None:
            frame_index += 1
            timestamp_ns = max(time.time_ns(), timestamp_ns + 1)
            check_size(
                read[1],
                width=self.width,
                height=self.height,
                where=f"{self.name}, frame {frame_index}",
            )
            yield Frame(
                frame_index=frame_index,
                timestamp_ns=timestamp_ns,
                image=read[1],
                source=self.name,
            )
        self.close()

    def close(self) -> None:
        """Let go of the device or connection; iteration ends."""
        self._capture.release()


def container_ns(milliseconds: float, *, frame_index: int, fps: float, previous_ns: int) -> int:
    """A container's timestamp as ns since the start of the stream, above `previous_ns`.

    OpenCV hands them out as float milliseconds; rounded to whole ns they are exact, since a double
    is off by some 0.01 ns after a day. (Matroska itself only keeps whole milliseconds.) Where the
    container has none (OpenCV then says 0) or nonsense, the frame rate tells the time. One that
    stands still or steps back is moved to 1 ns after the last, so that the right ones after it
    stay as they are.
    """
    if milliseconds == 0 or not abs(milliseconds) < _NONSENSE_MS:
        timestamp_ns = nominal_ns(frame_index, fps)
    else:
        timestamp_ns = round(milliseconds * 1e6)
    return max(timestamp_ns, previous_ns + 1)


def _read(capture: cv2.VideoCapture) -> tuple[float, UInt8[np.ndarray, "H W 3"]] | None:
    """The next picture with its time in ms; None at the end."""
    is_read, image = capture.read()
    return (capture.get(cv2.CAP_PROP_POS_MSEC), image) if is_read else None


def _fps_of(capture: cv2.VideoCapture, settings: ReadFramesSettings) -> float:
    fps = capture.get(cv2.CAP_PROP_FPS)
    return fps if math.isfinite(fps) and fps > 0 else settings.images_fps


def _start_of(path: Path) -> bytes:
    """The bytes that name a file's format. Raises SourceError where they can't be a video's."""
    try:
        with path.open("rb") as file:
            start = file.read(512)
    except OSError as error:
        raise SourceError(
            f"{path}: expected a video, but it can't be read: {error.strerror}"
        ) from None
    if not start:
        raise SourceError(f"{path}: expected a video, got an empty file; copy it again")
    if not start.translate(None, delete=_TEXT):  # FFmpeg would film a terminal that prints it
        raise SourceError(f"{path}: expected a video, got a text file")
    return start


def _why_unreadable(path: Path, start: bytes) -> str:
    """What to tell about a file that gives no picture."""
    if start[8:12] == b"WAVE" or start[:3] == b"ID3" or start[:4] in (b"fLaC", b"OggS"):
        return "expected a video, got an audio file with no pictures in it"
    if start[4:8] == b"ftyp" and not _has_index(path):
        return "expected a whole video, but its index (moov) at the end is missing; copy it again"
    return (
        "expected a video, but no picture in it can be decoded; "
        "it may hold sound only, be damaged, or not be a video at all"
    )


def _has_index(path: Path) -> bool:
    """Does an MP4 have its `moov` box? Walks the boxes at the top: size (4 bytes), name (4)."""
    with path.open("rb") as file:
        while len(head := file.read(16)) >= 8:
            size, name = int.from_bytes(head[:4]), head[4:8]
            if name == b"moov":
                return True
            if size == 1:  # the true size follows in 8 bytes
                size = int.from_bytes(head[8:16])
            if size < 8:
                return False
            file.seek(size - len(head), os.SEEK_CUR)
    return False
