"""A folder of clips, to which a recorder on board may still be adding, as one source of frames."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event

from stream_dmr.errors import SourceError
from stream_dmr.files import natural_order
from stream_dmr.messages import Frame
from stream_dmr.sources.read_settings import ReadFramesSettings
from stream_dmr.sources.source import ResumePoint, Source
from stream_dmr.sources.video_file import VideoFile

_SUFFIXES = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".wmv"}
_SETTLE_S = 5.0  # a clip that has not grown for so long is complete, or never will be; chosen
_POLL_S = 0.5


@dataclass(frozen=True, kw_only=True)
class _FileState:
    """Size and time of the last write of a file, to see whether it still grows."""

    num_bytes: int
    modified_ns: int


class ClipFolder(Source):
    """The clips of a folder in natural order of their names, all of one size.

    Frames are numbered through all clips. A clip is read once it has stopped growing or a later
    one is there; what comes into it after that, such as after a pause of its recorder, is read as
    well. One that can't be read, or has another size, is left out with a warning. Capture
    times: a clip ends when its file was last modified, but never begins before its predecessor
    ended.
    """

    def __init__(self, folder: Path, settings: ReadFramesSettings) -> None:
        """Raises SourceError where no clip can be read."""
        self.name = folder.resolve().name
        self.warnings: list[str] = []
        self._folder = folder
        self._settings = settings
        self._closing = Event()
        self._begun: set[str] = set()  # names of clips that were read, are being read or left out
        self._frames_done: dict[str, int] = {}
        self._bytes_read: dict[str, int] = {}  # sizes of the clips when their reading began
        self._after_ns = 0
        self._video: VideoFile | None = None
        first = self._first_clip()
        self.width, self.height, self.fps = first.width, first.height, first.fps
        self.num_frames = None
        first.close()

    @property
    def is_endless(self) -> bool:
        """True: the folder may grow; it ends when no new clip came for `clips_wait_s`."""
        return True

    @property
    def has_clips(self) -> bool:
        """True."""
        return True

    def resume(self, point: ResumePoint) -> None:
        """Skip the clips and frames that were done, and begin after the last capture time."""
        self._begun.update(point.clips_done)
        self._frames_done, self._after_ns = {**point.frames_done}, point.after_ns

    def __iter__(self) -> Iterator[Frame]:
        frame_index, last_ns = 0, self._after_ns
        while (path := self._next_clip()) is not None:
            if path.name in self._bytes_read:
                done = self._frames_done.get(path.name, 0)
                self.warnings.append(f"{path.name}: grew after its {done} frames were read")
            self._begun.add(path.name)
            state = _state_of(path)
            self._bytes_read[path.name] = 0 if state is None else state.num_bytes
            self._video = self._open(path)
            if self._video is None:
                continue
            start_ns = max(_start_ns(path, self._video), last_ns + round(1e9 / self._video.fps))
            for frame in self._video:
                frame_index += 1
                last_ns = start_ns + frame.timestamp_ns
                if frame.frame_index > self._frames_done.get(path.name, 0):
                    self._frames_done[path.name] = frame.frame_index
                    yield replace(frame, frame_index=frame_index, timestamp_ns=last_ns)
            self.warnings += self._video.warnings

    def close(self) -> None:
        """Release the clip; the iteration ends."""
        self._closing.set()
        if self._video is not None:
            self._video.close()

    def _first_clip(self) -> VideoFile:
        problem = SourceError(f"{self._folder}: expected clips, found none")
        for path in clips_in(self._folder):
            try:
                return VideoFile(path, self._settings)
            except SourceError as error:
                problem = error
        raise problem

    def _open(self, path: Path) -> VideoFile | None:
        try:
            video = VideoFile(path, self._settings)
        except SourceError as error:
            self.warnings.append(f"{error}; the clip was left out")
            return None
        if (video.width, video.height) != (self.width, self.height):
            video.close()
            self.warnings.append(
                f"{path.name}: expected {self.width}x{self.height} px as the first clip has, got "
                f"{video.width}x{video.height} px; the clip was left out"
            )
            return None
        return video

    def _has_more(self, path: Path) -> bool:
        """True for a clip that was not read, or has grown since."""
        if path.name not in self._begun:
            return True
        state, num_bytes = _state_of(path), self._bytes_read.get(path.name)
        return state is not None and num_bytes is not None and state.num_bytes > num_bytes

    def _next_clip(self) -> Path | None:
        """Wait for a complete clip; None when closed, or when none came for `clips_wait_s`."""
        seen: dict[str, _FileState] = {}
        unchanged_since = waiting_since = time.monotonic()
        while not self._closing.is_set():
            paths = [path for path in clips_in(self._folder) if self._has_more(path)]
            if len(paths) > 1:
                return paths[0]
            now = time.monotonic()
            if paths:
                state = _state_of(paths[0])
                if state is None:
                    continue
                if state != seen.get(paths[0].name):
                    seen[paths[0].name] = state
                    unchanged_since = waiting_since = now
                if now - unchanged_since >= _SETTLE_S or _is_old(state):
                    return paths[0]
            elif now - waiting_since >= self._settings.clips_wait_s:
                return None
            self._closing.wait(_POLL_S)
        return None


def clips_in(folder: Path) -> list[Path]:
    """The videos of a folder, in natural order. Raises SourceError where it can't be read."""
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
        files = [path for path in files if path.is_file() and not path.name.startswith(".")]
    except OSError as error:
        raise SourceError(
            f"{folder}: expected a folder of clips, but it can't be read: {error.strerror}"
        ) from None
    return sorted(files, key=natural_order)


def _state_of(path: Path) -> _FileState | None:
    """Size and time of the last write; None where the file was removed meanwhile."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return _FileState(num_bytes=status.st_size, modified_ns=status.st_mtime_ns)


def _is_old(state: _FileState) -> bool:
    """Whether the last write was longer ago than `_SETTLE_S`, by the wall clock that files use."""
    return time.time_ns() - state.modified_ns > _SETTLE_S * 1e9


def _start_ns(path: Path, video: VideoFile) -> int:
    """Capture time of the first frame: last write minus duration, ns since 1970; 0 if removed."""
    state, duration_s = _state_of(path), (video.num_frames or 0) / video.fps
    return 0 if state is None else state.modified_ns - round(duration_s * 1e9)
