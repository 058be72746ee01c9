"""Frames of video files."""

import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
from jaxtyping import UInt8

from stream_dmr.errors import SourceError
from stream_dmr.files import open_file
from stream_dmr.messages import Frame
from stream_dmr.sources.decoder import (
    DecodedPicture,
    DecodingError,
    LateError,
    ResizedError,
    open_decoder,
)
from stream_dmr.sources.source import ReadFramesSettings, Source, nominal_ns, size_error

# OpenCV passes on whatever a damaged container or a stream claims; outside of these it is no claim.
_MAX_MS = 1e12  # 31 years
_MIN_FPS, _MAX_FPS = 1e-3, 1e6
_MAX_FRAMES = 1e12
_NEAR_END = 3  # frames; at a variable rate the last frame may stand for longer
_MAX_BACK_NS = 1_000_000_000  # chosen: rounding and reordered pictures step back by less
_MATROSKA = b"\x1a\x45\xdf\xa3"  # and WebM
_TEXT_BYTES = bytes(range(32, 127)) + b"\t\r\n"
# Chosen: pictures without combs, also of ripples, foam or gravel, stay far below.
_COMB_EVERY, _COMBED_PICTURES = 10, 5  # of the pictures looked at, so many must be combed
_COMB_STEP = 12  # grey levels from a line to the next
_MIN_COMBED = 1e-3  # of a picture's pixels
_COMBED_RATIO = 5.0  # of stripes that lie to stripes that stand: in fine texture it is near 1


class VideoFile(Source):
    """A video file. A damaged file is read as far as FFmpeg conceals the damage, with a warning."""

    def __init__(self, path: Path, settings: ReadFramesSettings) -> None:
        """Raises SourceError if not even a first frame can be read."""
        self.name = path.name
        self.warnings: list[str] = []
        self._on_notice: Callable[[str], None] = self.warnings.append
        self._timeout_s = settings.silence_s
        self._is_closed = False
        self._first_error, self._is_noted = 0, False  # about the frame of it; 0: none
        self._num_combed = 0
        self.is_interlaced = False  # True once it was named
        self._later_ns = 0  # added to the times of the container since its clock went back
        start = _first_bytes(path)
        self._is_matroska = start.startswith(_MATROSKA)
        self._may_have_gaps = start.startswith((_MATROSKA, b"RIFF"))  # or AVI
        self._decoder = open_decoder(path)
        try:
            self._first = self._decoder.read(timeout_s=self._timeout_s)
        except LateError:
            self._decoder.close()
            raise SourceError(
                f"{path}: expected a picture within [read_frames] silence_s = {self._timeout_s:g} "
                "s, got none; give a longer wait, or check the file"
            ) from None
        except DecodingError:
            self._first = None
        if self._first is None:
            self._decoder.close()
            raise SourceError(f"{path}: {_unreadable_reason(path, start)}")
        self.height, self.width = self._decoder.height, self._decoder.width
        promised = self._decoder.promised
        if self._is_matroska:  # its duration, of which OpenCV computes the number, begins at zero
            promised -= min(self._decoder.before_start, max(promised - 1, 0.0))
        self.num_frames = promised_frames(promised)
        self.fps = plausible_fps(self._decoder.fps, settings)
        if self._decoder.turned_deg % 360 and settings.orientation == "sensor":
            self.warnings.append(
                f"{path.name}: the file asks to be turned by {self._decoder.turned_deg:g} degrees, "
                "and is measured so; a calibration of pictures that were not turned so gives wrong "
                "lengths"
            )

    def __iter__(self) -> Iterator[Frame]:
        """Raises SourceError at a frame of another size."""
        frame_index, timestamp_ns = 0, -1
        pending, self._first = self._first, None
        while pending is not None:
            self._note_errors()  # of the frame before: at a cut file's last frame it is the cut
            frame_index += 1
            if self._decoder.num_errors and not self._first_error:
                self._first_error = frame_index
            if frame_index % _COMB_EVERY == 0 and not self.is_interlaced:
                self._note_combs(pending.image)
            timestamp_ns = self._time_ns(pending, frame_index, previous_ns=timestamp_ns)
            yield Frame(
                frame_index=frame_index,
                timestamp_ns=timestamp_ns,
                image=pending.image,
                source=self.name,
            )
            pending = self._read(after=frame_index)
        self._warn_if_cut_off(frame_index, last_ns=timestamp_ns)
        if not self.is_cut_off and self._decoder.num_errors:
            self._first_error = self._first_error or frame_index
            self._note_errors()
        self.close()

    def close(self) -> None:
        self._is_closed = True
        self._first = None
        self._decoder.close()

    def _time_ns(self, picture: DecodedPicture, frame_index: int, *, previous_ns: int) -> int:
        """The time of a picture. Where files were joined, the clock goes on from the one before."""
        if _is_time(picture.milliseconds):
            time_ns = round(picture.milliseconds * 1e6)
            if self._later_ns and 0 < time_ns - previous_ns < _MAX_BACK_NS:
                self._later_ns = 0  # a single wrong time lay between
            back_ns = previous_ns - self._later_ns - time_ns
            if back_ns > _MAX_BACK_NS:
                if not self._later_ns:
                    self._on_notice(
                        f"{self.name}: its clock goes back by {back_ns / 1e9:.1f} s at frame "
                        f"{frame_index}, as in files that were joined; times go on from the frame "
                        "before, as if nothing lay between"
                    )
                self._later_ns += back_ns + nominal_ns(2, self.fps)
        return container_ns(
            picture.milliseconds,
            frame_index=frame_index,
            fps=self.fps,
            previous_ns=previous_ns,
            later_ns=self._later_ns,
        )

    def _note_errors(self) -> None:
        """Warn once that FFmpeg conceals parts that it could not decode."""
        if self._first_error and not self._is_noted:
            self._is_noted = True
            self._on_notice(
                f"{self.name}: FFmpeg reports errors from about frame {self._first_error} on; the "
                "file seems damaged, and pictures there are made up in part"
            )

    def _note_combs(self, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Warn once of interlaced pictures: a fish that moves along itself looks longer in them."""
        grey = image[..., 1]
        lying = _striped(grey[:, ::4])
        self._num_combed += lying > _MIN_COMBED + _COMBED_RATIO * _striped(grey[::4].T)
        if self._num_combed == _COMBED_PICTURES:
            self.is_interlaced = True
            self._on_notice(
                f"{self.name}: its pictures seem interlaced (every second line is of another "
                "moment), so that moving fish look too long; deinterlace the film and measure "
                "that, e.g. ffmpeg -i OLD -vf bwdif=0 NEW"
            )

    def _read(self, *, after: int) -> DecodedPicture | None:
        """The next picture; None at the end, also with a warning if the decoder fails."""
        try:
            return None if self._is_closed else self._decoder.read(timeout_s=self._timeout_s)
        except ResizedError as error:
            raise size_error(
                (error.width, error.height),
                expected=(self.width, self.height),
                where=f"{self.name}, frame {after + 1}",
            ) from None
        except DecodingError as error:
            if not self._is_closed:
                self.is_cut_off = True
                self.warnings.append(
                    f"{self.name}: {error} after frame {after}; the file seems damaged there"
                )
            return None

    def _warn_if_cut_off(self, num_read: int, *, last_ns: int) -> None:
        """Containers without a frame count promise duration x rate, which may be 1 too many.

        Matroska has no count; at a variable rate any number of frames may be all of a duration. An
        AVI counts the frames that its camera dropped, and leaves a gap in time for them.
        """
        if self._is_closed or not self.num_frames:
            return
        if self._may_have_gaps and last_ns >= nominal_ns(self.num_frames - _NEAR_END, self.fps):
            self.num_frames = num_read
        if num_read < self.num_frames - 1:
            self.is_cut_off = True
            self.warnings.append(
                f"{self.name}: the file promises {self.num_frames} frames, only {num_read} could "
                "be read; it seems cut off or damaged"
            )


def _striped(grey: UInt8[np.ndarray, "H W"]) -> float:
    """Fraction of the pixels from which a column goes up and down in turns for four lines."""
    steps = np.diff(grey.astype(np.int16), axis=0)
    up, down = steps > _COMB_STEP, steps < -_COMB_STEP
    turns = (up[1:] & down[:-1]) | (down[1:] & up[:-1])
    return float(np.count_nonzero(turns[2:] & turns[1:-1] & turns[:-2])) / grey.size


def _is_time(milliseconds: float) -> bool:
    """False for what OpenCV returns without a timestamp, and for an impossible one."""
    return milliseconds != 0 and abs(milliseconds) < _MAX_MS


def container_ns(
    milliseconds: float, *, frame_index: int, fps: float, previous_ns: int, later_ns: int = 0
) -> int:
    """A container's timestamp, plus `later_ns`, as ns since the start, above `previous_ns`.

    OpenCV returns milliseconds as floats; rounded to whole ns they are exact, since a double is off
    by some 0.01 ns after a day. (Matroska itself only keeps whole milliseconds.) If the container
    has no timestamp (OpenCV then returns 0) or an impossible one, the nominal time at `fps` is
    used. A time that repeats or steps back becomes 1 ns after the previous time, so that the
    correct times after it stay as they are.
    """
    if _is_time(milliseconds):
        timestamp_ns = round(milliseconds * 1e6) + later_ns
    else:
        timestamp_ns = nominal_ns(frame_index, fps)
    return max(timestamp_ns, previous_ns + 1)


def plausible_fps(fps: float, settings: ReadFramesSettings) -> float:
    """The container's frame rate; `images_fps` if it is missing or impossible."""
    return fps if _MIN_FPS <= fps <= _MAX_FPS else settings.images_fps


def promised_frames(promised: float) -> int | None:
    """The container's number of frames; None if it is missing or impossible."""
    return int(promised) if 1 <= promised < _MAX_FRAMES else None


def _first_bytes(path: Path) -> bytes:
    """The bytes that identify a file's format. Raises SourceError if they can't be a video's."""
    try:
        with open_file(path) as file:
            start = file.read(512)
    except OSError as error:
        raise SourceError(
            f"{path}: expected a video, but it can't be read: {error.strerror}"
        ) from None
    if not start:
        raise SourceError(f"{path}: expected a video, got an empty file; copy it again")
    if not start.translate(None, delete=_TEXT_BYTES):  # FFmpeg would render the text as a video
        raise SourceError(f"{path}: expected a video, got a text file")
    return start


def _unreadable_reason(path: Path, start: bytes) -> str:
    """The reason why a file has no picture, by its first bytes and its MP4 index."""
    if start[8:12] == b"WAVE" or start[:3] == b"ID3" or start[:4] in (b"fLaC", b"OggS"):
        return "expected a video, got an audio file with no pictures in it"
    if start[4:8] == b"ftyp" and not _has_index(path):
        return "expected a whole video, but its index (moov) at the end is missing; copy it again"
    return (
        "expected a video, but no picture in it can be decoded; "
        "it may hold sound only, be damaged, or not be a video at all"
    )


def _has_index(path: Path) -> bool:
    """True if an MP4 has its `moov` box.

    Walks the top-level boxes: size (4 bytes, big-endian), name (4); ISO/IEC 14496-12, 4.2.
    """
    end = path.stat().st_size
    with path.open("rb") as file:
        while len(head := file.read(16)) >= 8:
            size, name = int.from_bytes(head[:4]), head[4:8]
            if name == b"moov":
                return True
            if size == 1:  # the true size follows in 8 bytes
                size = int.from_bytes(head[8:16])
            if not 8 <= size <= end:  # damaged
                return False
            file.seek(size - len(head), os.SEEK_CUR)
    return False


# FFmpeg reads its level once, at its first use in the process.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET


_LEAD_MS = 200.0  # containers round their times: a search begins a little earlier
_AHEAD_MS = 2000.0  # reading on to a later picture is quicker than a new search up to here; chosen
_MAX_TOLERANCE_MS = 20.0  # a picture's time is the same whenever it is read, but for rounding


class SeekableVideo:
    """Pictures of a video that a run has read before, in any order. Thread-safe.

    It decodes in this process: a file that a run has read to its end does not crash the decoder.
    """

    def __init__(self, path: Path) -> None:
        self._opens = (str(path.resolve()), cv2.CAP_FFMPEG)
        self._capture = cv2.VideoCapture(*self._opens)
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        # Half a frame; the rate of a film with pauses is a mean of all, and of no use.
        half_ms = 500.0 / fps if 1e-3 < fps < 1e6 else 1.0
        self._tolerance_ms = min(half_ms, _MAX_TOLERANCE_MS)
        self._next_ms = 0.0  # approximate time of the next picture to be read
        self._lock = Lock()

    def image_at(self, timestamp_ns: int) -> UInt8[np.ndarray, "H W 3"] | None:
        """The picture of a capture time as BGR; None if the video has none then."""
        wanted_ms = timestamp_ns / 1e6
        with self._lock:
            if not self._next_ms - self._tolerance_ms <= wanted_ms <= self._next_ms + _AHEAD_MS:
                self._capture.set(cv2.CAP_PROP_POS_MSEC, max(0.0, wanted_ms - _LEAD_MS))
                at_ms = self._grab()
                # FFmpeg searches by the mean rate, and finds nothing in a file of one picture.
                if at_ms > wanted_ms + self._tolerance_ms:
                    self._capture.open(*self._opens)
                    at_ms = self._grab()
            else:
                at_ms = self._grab()
            while at_ms <= wanted_ms + self._tolerance_ms:
                if at_ms > wanted_ms - self._tolerance_ms:
                    is_read, image = self._capture.retrieve()
                    return image if is_read and image.ndim == 3 else None
                at_ms = self._grab()
            return None

    def _grab(self) -> float:
        """Take the next picture; its time in ms, infinite at the end, after which is searched."""
        if not self._capture.grab():
            self._next_ms = math.inf
            return math.inf
        at_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        self._next_ms = at_ms + 2 * self._tolerance_ms
        return at_ms

    def close(self) -> None:
        with self._lock:
            self._capture.release()
