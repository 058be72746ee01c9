"""Records and the sinks that take them."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.messages import FishCrop, FittedMesh, Frame, Message
from stream_dmr.recording.codec import checksum, compress, decompress, encode
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.topics import SECOND_TOPICS, TOPICS, RecordingSettings, Topic


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """A message and its encoding, made once for all sinks."""

    message: Message  # as read from a recording, but a frame may keep its original pixels
    whole: Message  # with the parts that the recording leaves out: for drawing
    encoding: Callable[[], bytes]
    is_second: bool = False  # of the second camera of two

    @cached_property
    def payload(self) -> bytes:
        return self.encoding()

    @property
    def topic(self) -> Topic:
        return (SECOND_TOPICS if self.is_second else TOPICS)[type(self.message)]


def make_record(message: Message, settings: RecordingSettings) -> Record:
    """The record of a message: parts may be left out and pictures may be lossy.

    If a replay starts from a lossy picture, the run continues from it too. If crops are kept, the
    picture of a frame is only for viewing, since a replay then starts from the crops.
    """
    if isinstance(message, Frame):
        return _record_frame(message, settings)
    recorded, picture = message, None
    match message:
        case FishCrop(image=image) if image is not None and settings.crops == "jpeg":
            picture = compress(image, format="jpeg", jpeg_quality=settings.jpeg_quality)
            recorded = replace(message, image=decompress(picture))
        case FishCrop() if not settings.keeps_crops:
            recorded = replace(message, image=None)
        case FittedMesh(shape=shape) if shape is not None and settings.meshes == "parameters":
            recorded = replace(message, shape=replace(shape, vertices=None, covariance=None))
        case _:
            pass
    return Record(
        message=recorded, whole=message, encoding=partial(encode, recorded, picture=picture)
    )


def as_recorded(message: Message, settings: RecordingSettings) -> Message:
    """The message as read from a recording, which a replay compares with and continues from."""
    return make_record(message, settings).message


def _record_frame(frame: Frame, settings: RecordingSettings) -> Record:
    """A frame by reference or with a picture for viewing keeps its own pixels in the run."""
    if settings.frames != "jpeg" or settings.keeps_crops:
        return Record(message=frame, whole=frame, encoding=partial(_encode_frame, frame, settings))
    picture = compress(frame.image, format="jpeg", jpeg_quality=settings.jpeg_quality)
    decoded = replace(frame, image=decompress(picture))
    return Record(message=decoded, whole=frame, encoding=partial(encode, decoded, picture=picture))


def _encode_frame(frame: Frame, settings: RecordingSettings) -> bytes:
    if settings.frames != "jpeg":
        return encode(frame, picture=compress(frame.image, format="reference"))
    picture = compress(frame.image, format="jpeg", jpeg_quality=settings.jpeg_quality)
    return encode(frame, picture=replace(picture, crc32=checksum(frame.image)))


@runtime_checkable
class Sink(Protocol):
    """One kind of output."""

    @property
    def name(self) -> str:
        """The name of its file, for people."""
        ...

    def write(self, record: Record, /) -> None:
        """Take one record. Raises OutputError if the disk refuses it."""
        ...

    def close(self) -> None:
        """Leave a valid file. Idempotent. Raises OutputError if the disk refuses its end."""
        ...


@runtime_checkable
class BufferedSink(Sink, Protocol):
    """A sink that keeps records for a moment and writes them together."""

    def flush_due(self) -> None:
        """Write records that were kept long enough. Raises OutputError if the disk refuses it."""
        ...


@runtime_checkable
class FileSink(Sink, Protocol):
    """A sink that writes one file."""

    path: Path  # of the file when it is closed


SinkFactory = Callable[[Path, RunHeader, RecordingSettings], Sequence[Sink]]
"""Opens the sinks that record a run in a folder. Raises as `open_recording_files` does."""


@dataclass(frozen=True, kw_only=True)
class SinkState:
    """One output, such as `frames.csv`."""

    name: str
    is_failing: bool
    since_ns: int  # wall clock, ns since 1970: it works, or fails, since then
    last_error: str = ""  # also after it works again

    @property
    def problem(self) -> str:
        """Why it fails, for people; "" while it works."""
        return f"{self.name} can't be written: {self.last_error}" if self.is_failing else ""


class SinkStates:
    """The state of each output, as reported by its writer. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._states: dict[str, SinkState] = {}

    def report(self, name: str, error: str = "") -> None:
        """An output was written to, or was refused with `error`."""
        with self._lock:
            state, is_failing = self._states.get(name), bool(error)
            if state is None:
                state = SinkState(name=name, is_failing=is_failing, since_ns=time.time_ns())
            elif state.is_failing != is_failing:
                state = replace(state, is_failing=is_failing, since_ns=time.time_ns())
            self._states[name] = replace(state, last_error=error) if error else state

    def all(self) -> list[SinkState]:
        """The states of all outputs, in the order in which they were first written to."""
        with self._lock:
            return list(self._states.values())

    def problems(self) -> list[str]:
        return [state.problem for state in self.all() if state.is_failing]


_MAX_TRACKS = 1000  # the last tracks, which are counted; chosen


class PhotographChooser:
    """Chooses the 1st, 2nd, 4th, 8th, ... crop in which a fish does not touch the border.

    So a fish has a few photographs from all of the time that it is in view: 1 + log2(n) of n crops.
    Of a fish that always touches the border, the first crop is chosen.
    """

    def __init__(self) -> None:
        self._inside: dict[int, int] = {}  # crops of each track inside the picture

    def takes(self, crop: FishCrop) -> bool:
        """True for a crop whose picture is to be kept; called once for each crop, in order."""
        is_new = crop.track_id not in self._inside
        count = self._inside.setdefault(crop.track_id, 0)
        if len(self._inside) > _MAX_TRACKS:
            del self._inside[next(iter(self._inside))]
        if crop.quality.touches_border:
            return is_new
        self._inside[crop.track_id] = count = count + 1
        return count & (count - 1) == 0
