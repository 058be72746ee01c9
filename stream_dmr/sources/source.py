"""The interface of a source of frames, and the settings of `[read_frames]`."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from pydantic import Field

from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.settings import Settings

_SECOND_NS = 1_000_000_000


@dataclass(kw_only=True)
class CameraCounts:
    """Frames of a live source: received = passed on + dropped + failed + waiting."""

    received: int = 0
    passed_on: int = 0
    dropped: int = 0  # newer frames came before the chain had time for them
    failed: int = 0  # of another size than the camera's first
    reconnects: int = 0
    last_arrival_ns: int = 0  # monotonic clock

    @property
    def waiting(self) -> int:
        """Frames that the chain has not taken yet."""
        return self.received - self.passed_on - self.dropped - self.failed


@dataclass(frozen=True, kw_only=True)
class ResumePoint:
    """How far earlier runs in the same output folder came."""

    after_ns: int = 0  # the last capture time; every later one must be larger
    clips_done: frozenset[str] = frozenset()  # names of clips that were read to their end
    frames_done: Mapping[str, int] = field(default_factory=dict[str, int])  # of the other clips
    mark_done: Callable[[str], object] = str  # takes the name of a clip that needs no reading


class Source(ABC):
    """Frames in order, to be iterated once; `frame_index` from 1, `timestamp_ns` increasing.

    The attributes describe what a source can do, so that no user has to ask for its class. The
    defaults are those of a file: it ends, can be read again, and begins again in every run.
    """

    name: str  # file name or address, for people
    width: int  # px, of every frame
    height: int
    num_frames: int | None  # promised by the source; None if unknown
    fps: float
    is_cut_off: bool = False  # True if it ended too early, or by damage
    warnings: list[str]  # problems that did not end the reading, one line each; complete at the end
    # True for cameras and growing folders, which end only when closed (or idle for long).
    is_endless: bool = False
    is_live: bool = False  # True for cameras and streams: their frames come by themselves, once
    has_clips: bool = False  # True if `Frame.source` names a clip of several, each read once

    @property
    def counts(self) -> CameraCounts | None:
        """Frames received, passed on and lost so far; None unless the source `is_live`."""
        return None

    def listen(self, on_notice: Callable[[str], None]) -> None:
        """Call `on_notice`, in any thread, with a line for each loss and return of a camera.

        Problems of a clip are reported here at once, and are not in `warnings`.
        """
        self._on_notice = on_notice

    def announce_pauses(self, on_pause: Callable[[], None]) -> None:  # noqa: B027, optional
        """Call `on_pause`, in the iterating thread, if clips stay away for longer than usual."""

    def resume(self, point: ResumePoint) -> None:  # noqa: B027, optional
        """Continue after earlier runs; call it before the iteration."""

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Raises SourceError if a frame doesn't fit the frames before it."""

    @abstractmethod
    def close(self) -> None:
        """Release the file or device; the iteration ends."""


def nominal_ns(frame_index: int, fps: float) -> int:
    """The time of a frame at a constant rate, if no other is known; ns since the first frame."""
    return round((frame_index - 1) * _SECOND_NS / fps)


def size_error(size: tuple[int, int], *, expected: tuple[int, int], where: str) -> SourceError:
    """The error for a frame of another size; both are width and height in px."""
    return SourceError(
        f"{where}: expected {expected[0]}x{expected[1]} px, as the first frame has, got "
        f"{size[0]}x{size[1]} px; pictures of one source must have one size"
    )


class ReadFramesSettings(Settings):
    """`[read_frames]`: how a source is read."""

    images_fps: float = Field(
        default=30.0,
        gt=0,
        allow_inf_nan=False,
        description="frames/s of folders of pictures and of videos without timestamps",
    )
    other_sizes: Literal["refuse", "leave_out", "take"] = Field(
        default="refuse",
        description="pictures of a folder whose size is not the first one's; --stills takes them "
        "without a calibration, and with one leaves out those whose size is not the calibration's",
    )
    orientation: Literal["auto", "upright", "sensor"] = Field(
        default="auto",
        description="how pictures are read whose EXIF asks for a rotation: rotated (upright) or as "
        "the sensor saw them; auto: sensor with a calibration, else upright",
    )
    silence_s: float = Field(
        default=20.0,
        ge=0.1,
        le=3600,
        description="a camera or decoder that gives no frame for this long is restarted, s",
    )
    connect_s: float = Field(
        default=6.0,
        ge=0.1,
        le=3600,
        description="longest wait for a first frame; more than the time between key frames, s",
    )
    retry_s: float = Field(
        default=3.0,
        ge=0.1,
        le=3600,
        description="longest pause between two attempts to reconnect to a camera, s",
    )
    live_queue: int = Field(
        default=15,
        ge=1,
        le=1000,
        description="frames of a live source that may wait, about one second; when full, the "
        "oldest is dropped",
    )
    clips_wait_s: float = Field(
        default=30.0,
        ge=0,
        description="a folder of clips ends when no new clip came for this long, s; at sea 1e9",
    )
