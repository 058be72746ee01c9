"""Frames of folders: pictures, and clips that keep coming."""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Literal

import cv2
import numpy as np

from stream_dmr.errors import SourceError
from stream_dmr.files import natural_order
from stream_dmr.messages import Frame
from stream_dmr.pictures import (
    MAX_PIXELS,
    PICTURE_SUFFIXES,
    is_turned,
    pictures_in,
    read_picture,
    size_if_huge,
    stored_size,
)
from stream_dmr.sources.source import ReadFramesSettings, ResumePoint, Source, nominal_ns
from stream_dmr.sources.video_file import VideoFile

OtherSizes = Literal["refuse", "leave_out", "take"]
_DEPTHS = {"uint8", "uint16"}
# Formats of telephones and cameras that OpenCV does not read.
_UNREADABLE = {".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2"}
_MAX_NAMED = 20  # pictures of one other size


class PictureFolder(Source):
    """A folder of pictures in natural order (`2.png` before `10.png`), usually of one size.

    Grey and 16-bit pictures become 8-bit BGR. A picture that can't be decoded, or is cut off, is
    left out with a warning but keeps its frame index: boxes and masks stay with their pictures.
    """

    def __init__(
        self,
        folder: Path,
        *,
        fps: float,
        other_sizes: OtherSizes = "refuse",
        as_sensor: bool = False,
        size: tuple[int, int] | None = None,
    ) -> None:
        """`other_sizes`: how to treat pictures of another size than the first one's.

        "leave_out" keeps `size`, width and height in px, if any picture has it, else the size that
        most have. `as_sensor`: pictures are not turned upright, see `[read_frames] orientation`.
        Raises SourceError if no picture can be decoded.
        """
        self._paths, unreadable = _pictures_in(folder)
        self._is_closed = False
        self._other_sizes = other_sizes
        self.name = folder.resolve().name
        self.num_frames = len(self._paths)
        self.fps = fps
        self.warnings = [] if not unreadable else [_not_read(unreadable)]
        self._as_sensor, self._is_warned = as_sensor, False
        first = next((p for p in map(self._read, self._paths) if p is not None), None)
        if first is None:
            raise SourceError(
                f"{folder}: expected pictures of 8 or 16 bits, but none of its {len(self._paths)} "
                "can be decoded"
            )
        self.height, self.width = first.shape[:2]
        if other_sizes == "leave_out":  # the first picture may be of another telephone
            sizes = Counter(p.shape[1::-1] for p in self._sample()) or {first.shape[1::-1]: 1}
            most = max(sizes, key=lambda size: sizes[size])
            self.width, self.height = size if size is not None and self._has(size) else most
        self._others = defaultdict[tuple[int, int], list[str]](list)  # left out, by size
        self._white: int | None = None  # of 16-bit pictures, known from the first one on

    def __iter__(self) -> Iterator[Frame]:
        return self.since(1)

    def since(self, first: int) -> Iterator[Frame]:
        """The frames from an index on: those before need not be decoded."""
        for frame_index, path in enumerate(self._paths[first - 1 :], start=first):
            if self._is_closed:
                return
            picture = self._read(path)
            if picture is None:
                self.warnings.append(
                    f"{path.name}: can't be decoded, or is cut off, so was left out"
                )
                continue
            if self._as_sensor and not self._is_warned and is_turned(path):
                self._is_warned = True
                self.warnings.append(
                    f"pictures such as {path.name} are to be turned by their EXIF; with a "
                    "calibration they are measured as the sensor saw them, and masks and boxes "
                    "must be so"
                )
            size = picture.shape[1], picture.shape[0]
            if self._other_sizes == "refuse" and size != (self.width, self.height):
                raise SourceError(
                    f"{path}: expected {self.width}x{self.height} px, as the first picture has, "
                    f"got {size[0]}x{size[1]} px; give --stills where pictures stand for "
                    'themselves, or set [read_frames] other_sizes to "leave_out" or "take"'
                )
            if self._other_sizes == "leave_out" and size != (self.width, self.height):
                self._leave_out(path.name, size)
                continue
            if picture.dtype != np.uint8:  # one factor for the whole folder: it must not flicker
                self._white = self._white or self._white_of(picture)
                picture = cv2.convertScaleAbs(picture, alpha=255 / self._white)
            yield Frame(
                frame_index=frame_index,
                timestamp_ns=nominal_ns(frame_index, self.fps),
                image=picture,
                source=path.name,
            )

    def _has(self, size: tuple[int, int]) -> bool:
        """True if any picture has a size; those that may have it by their headers are decoded."""
        for path in self._paths:
            if not size_if_huge(path) and stored_size(path) in (size, size[::-1]):
                picture = self._read(path)
                if picture is not None and picture.shape[1::-1] == size:
                    return True
        return False

    def _leave_out(self, name: str, size: tuple[int, int]) -> None:
        """Name a picture of another size: all of that size in one warning."""
        before = self._left_out(size)
        self._others[size].append(name)
        self.warnings = [line for line in self.warnings if line != before] + [self._left_out(size)]

    def _left_out(self, size: tuple[int, int]) -> str:
        names, more = self._others[size][:_MAX_NAMED], len(self._others[size]) - _MAX_NAMED
        listed = ", ".join([*names, *([f"{more} more"] if more > 0 else [])])
        return (
            f"left out, as the calibration is for pictures of {self.width}x{self.height} px and "
            f"not of {size[0]}x{size[1]}: {listed}; calibrate for these and run them by themselves"
        )

    def _read(self, path: Path) -> np.ndarray | None:
        """The picture as BGR of its own depth; None if it can't be read, or not to its end.

        Raises SourceError for a picture that is too large, before it takes the memory.
        """
        if huge := size_if_huge(path):
            raise SourceError(
                f"{path}: expected a picture of {MAX_PIXELS // 10**6} megapixels or less, got "
                f"{huge}"
            )
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
        if self._as_sensor:
            flags |= cv2.IMREAD_IGNORE_ORIENTATION
        try:
            picture = read_picture(path, flags)
        except OSError:
            return None
        return picture if picture is not None and picture.dtype.name in _DEPTHS else None

    def _white_of(self, picture: np.ndarray) -> int:
        """The value of white in 16-bit pictures of the folder, such as `picture`.

        Sensors of 12 bits often write their values unscaled into 16 bits, which look all but black.
        A folder is taken for 12 bits if a sample of it stays below 4096.
        """
        is_dim = all(p.max() < 2**12 for p in (picture, *self._sample()))
        return 2**12 - 1 if is_dim else 2**16 - 1

    def _sample(self) -> Iterator[np.ndarray]:
        """About five pictures, evenly spaced, without unreadable pictures."""
        sample = map(self._read, self._paths[:: max(1, len(self._paths) // 4)])
        return (picture for picture in sample if picture is not None)

    def close(self) -> None:
        """End the iteration; no file is held."""
        self._is_closed = True


def _pictures_in(folder: Path) -> tuple[list[Path], list[str]]:
    """Readable pictures in natural order, and names of others. SourceError if there are none."""
    try:
        pictures = pictures_in(folder)
        files = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
    except OSError as error:
        raise SourceError(
            f"{folder}: expected a folder of pictures, but it can't be read: {error.strerror}"
        ) from None
    unreadable = sorted(p.name for p in files if p.suffix.lower() in _UNREADABLE)
    if pictures:
        return pictures, unreadable
    suffixes = ", ".join(sorted(PICTURE_SUFFIXES))
    found = _not_read(unreadable) if unreadable else "found none"
    raise SourceError(f"{folder}: expected a folder of pictures ({suffixes}) or of videos, {found}")


def _not_read(names: list[str]) -> str:
    return f"{len(names)} pictures such as {names[0]} can't be read; save them as JPEG or PNG"


_SUFFIXES = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".wmv"}
_MAX_EARLY_S = 3600.0  # of a clip's end, before the latest; chosen
_DAY_NS = 86_400_000_000_000  # to come, of a clip's end: more than a time zone is off; chosen
_SETTLE_S = 5.0  # a clip that has not grown for so long is complete, or never will be; chosen
_PAUSE_CLIPS = 2.0  # clips' durations without a new clip after which its fish are gone; chosen
_POLL_S, _MAX_POLL_SHARE = 0.5, 0.05  # of the time; listing ten thousand clips takes 0.2 s


@dataclass(frozen=True, kw_only=True)
class _FileState:
    """Size and time of the last write of a file, to see whether it still grows."""

    num_bytes: int
    modified_ns: int


@dataclass(kw_only=True)
class _Clip:
    """A name in a folder of clips."""

    is_begun: bool = False  # it was read, is being read or left out
    state: _FileState | None = None  # when its reading began; None: not by this run
    frames_done: int = 0
    is_own: bool = False  # the name came beside others, not in their place
    is_rewritten: bool = False  # another file has its name since


class ClipFolder(Source):
    """The clips of a folder in natural order of their names, all of one size.

    Frames are numbered through all clips. A clip is read once it has stopped growing or a later
    clip is there; frames that it receives after that, such as after a pause of its recorder, are
    read as well. A clip that can't be read, or has another size, is left out with a warning.
    Capture times: a clip ends when its file was last modified, unless that is a day or more to
    come, but never begins before its predecessor ended.
    """

    is_endless = True  # the folder may grow; it ends when no new clip came for `clips_wait_s`
    has_clips = True

    def __init__(self, folder: Path, settings: ReadFramesSettings) -> None:
        """Raises SourceError if no clip can be read."""
        self.name = folder.resolve().name
        self.warnings: list[str] = []
        self._folder = folder
        self._settings = settings
        self._closing = Event()
        self._on_notice: Callable[[str], None] = self.warnings.append
        self._clips = defaultdict[str, _Clip](_Clip)  # by name
        self._after_ns = 0
        self._latest_ns = 0  # the latest end of a clip, by its file
        self._is_early = False  # the last clip came late, or after a wrong time
        self._mark_done: Callable[[str], object] = str
        self._on_pause: Callable[[], None] = lambda: None
        self._clip_s = 0.0  # duration of the last clip
        self._video: VideoFile | None = None
        self._is_interlaced = False  # one clip was named, which holds for all
        first = self._first_clip()
        self.width, self.height, self.fps = first.width, first.height, first.fps
        self.num_frames = None
        first.close()

    def announce_pauses(self, on_pause: Callable[[], None]) -> None:
        self._on_pause = on_pause

    def resume(self, point: ResumePoint) -> None:
        """Skip the clips and frames that were done, and begin after the last capture time."""
        for name in point.clips_done:
            self._clips[name].is_begun = True
        for name, frames_done in point.frames_done.items():
            self._clips[name].frames_done = frames_done
        self._after_ns = self._latest_ns = point.after_ns
        self._mark_done = point.mark_done

    def __iter__(self) -> Iterator[Frame]:
        frame_index, last_ns = 0, self._after_ns
        while (path := self._next_clip()) is not None:
            clip = self._clips[path.name]
            done = clip.frames_done
            if clip.state is not None:
                self._on_notice(f"{path.name}: grew after its {done} frames were read")
            clip.is_begun = True
            clip.state = _state_of(path) or _FileState(num_bytes=0, modified_ns=0)
            if (video := self._open(path)) is None:
                continue
            self._video = video
            self._clip_s = (self._video.num_frames or 0) / self._video.fps
            ended_ns = self._ended_ns(path)
            start_ns = ended_ns - round(self._clip_s * 1e9)
            next_ns = last_ns + round(1e9 / self._video.fps)
            for frame in self._whole_frames(self._video):
                frame_index += 1
                if frame.frame_index == done + 1:  # frames read before may lie before the last time
                    if ended_ns:
                        self._note_early(path.name, ended_ns)
                    start_ns = max(start_ns, next_ns - frame.timestamp_ns)
                last_ns = max(last_ns, start_ns + frame.timestamp_ns)
                if frame.frame_index > done:
                    clip.frames_done = frame.frame_index
                    yield replace(frame, frame_index=frame_index, timestamp_ns=last_ns)
            for line in self._video.warnings:
                self._on_notice(line)
            self._is_interlaced = self._video.is_interlaced
            self.is_cut_off = self._video.is_cut_off  # of the last clip, which ends the frames

    def _whole_frames(self, video: VideoFile) -> Iterator[Frame]:
        """The frames of a clip up to the first of another size."""
        try:
            yield from video
        except SourceError as error:
            video.is_cut_off = True
            video.close()
            self._on_notice(f"{error}; the rest of the clip was left out")

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
            self._on_notice(f"{error}; the clip was left out")
            return None
        if (video.width, video.height) != (self.width, self.height):
            video.close()
            self._on_notice(
                f"{path.name}: expected {self.width}x{self.height} px as the first clip has, got "
                f"{video.width}x{video.height} px; the clip was left out"
            )
            return None
        video.is_interlaced = self._is_interlaced
        return video

    def _has_more(self, path: Path) -> bool:
        """True for a clip that was not read, or has grown since; names one that was replaced."""
        clip = self._clips[path.name]
        if not clip.is_begun:
            clip.is_own |= self._video is None  # nothing was read yet
            return clip.is_own or not self._is_renamed(path)
        state, before = _state_of(path), clip.state
        if state is None or before is None:
            return False
        later_s = (state.modified_ns - before.modified_ns) / 1e9
        is_longer = state.num_bytes > before.num_bytes
        if not is_longer and later_s > _SETTLE_S and not clip.is_rewritten:
            clip.is_rewritten = True
            self._on_notice(
                f"{path.name}: was written again after it was read, and is not read again: give "
                "each clip a name of its own, such as its time"
            )
        return is_longer

    def _is_renamed(self, path: Path) -> bool:
        """True for a new name of a clip that was read by one which is gone or reused; says so."""
        state = _state_of(path)
        same = [name for name, clip in self._clips.items() if clip.state == state]
        before = next((name for name in same if _state_of(self._folder / name) != state), None)
        if state is None or before is None:
            self._clips[path.name].is_own = True
            return False
        done = self._clips[before].frames_done  # it may still grow
        self._clips[path.name] = _Clip(is_begun=True, state=state, frames_done=done)
        self._mark_done(path.name)
        self._on_notice(f"{path.name}: is {before} by another name, so is not read again")
        return True

    def _ended_ns(self, path: Path) -> int:
        """When a clip ended, with its last write; 0 if unknown: it follows the clip before it."""
        state, now_ns = _state_of(path), time.time_ns()
        if state is None:
            return 0
        days = (state.modified_ns - now_ns) / _DAY_NS
        if days <= 1:
            return state.modified_ns
        self._on_notice(
            f"{path.name}: by its time of change it ends in {days:.1f} days, so its times are "
            "those after the clip before it; set the recorder's clock, or this machine's"
        )
        return 0 if self._latest_ns else now_ns

    def _note_early(self, name: str, ended_ns: int) -> None:
        early_s = (self._latest_ns - ended_ns) / 1e9
        self._latest_ns = max(self._latest_ns, ended_ns)
        if early_s > _MAX_EARLY_S and not self._is_early:
            self._on_notice(
                f"{name}: by its time of change it is {early_s:.0f} s older than what was measured "
                "before, and gets later times: it came late, or a clip before had a wrong time"
            )
        self._is_early = early_s > _MAX_EARLY_S

    def _next_clip(self) -> Path | None:
        """Wait for a complete clip; None when closed, or when none came for `clips_wait_s`."""
        seen: dict[str, _FileState] = {}
        unchanged_since = waiting_since = time.monotonic()
        # A recorder writes a clip when its time is over, so the next takes as long as the last.
        pause_s, is_pausing = max(_SETTLE_S, _PAUSE_CLIPS * self._clip_s), False
        while not self._closing.is_set():
            began = time.monotonic()
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
                age_s = (time.time_ns() - state.modified_ns) / 1e9  # by the clock that files use
                if now - unchanged_since >= _SETTLE_S or age_s > _SETTLE_S:
                    return paths[0]
            elif now - waiting_since >= self._settings.clips_wait_s:
                return None
            elif now - waiting_since >= pause_s and not is_pausing:
                is_pausing = True
                self._on_pause()
            wait_s = max(_POLL_S, (now - began) / _MAX_POLL_SHARE)
            self._closing.wait(min(wait_s, _SETTLE_S))
        return None


def clips_in(folder: Path) -> list[Path]:
    """The videos of a folder, in natural order. Raises SourceError if it can't be read."""
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
        files = [path for path in files if path.is_file() and not path.name.startswith(".")]
    except OSError as error:
        raise SourceError(
            f"{folder}: expected a folder of clips, but it can't be read: {error.strerror}"
        ) from None
    return sorted(files, key=natural_order)


def _state_of(path: Path) -> _FileState | None:
    """Size and time of the last write; None if the file was removed meanwhile."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return _FileState(num_bytes=status.st_size, modified_ns=status.st_mtime_ns)
