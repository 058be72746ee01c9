"""A camera or network stream as a source of frames, for weeks."""

import random
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from stream_dmr.errors import SourceError
from stream_dmr.messages import Frame
from stream_dmr.sources.capture_clock import CaptureClock
from stream_dmr.sources.decoder import Decoder, DecodingError, Picture
from stream_dmr.sources.settings import ReadFramesSettings
from stream_dmr.sources.video_file import usual_fps

_FIRST_PAUSE_S = 0.25
_LARGEST_STEP_NS = 1_000_000_000  # a clock is set right by less without a word
_MOST_FRAMES = 1e12


@dataclass(kw_only=True)
class CameraCounts:
    """Frames that came = frames passed on + dropped + failed + those that wait."""

    received: int = 0
    passed_on: int = 0
    dropped: int = 0  # newer ones came before the chain had time for them
    failed: int = 0  # of another size than the camera's first
    reconnects: int = 0
    last_arrival_ns: int = 0  # monotonic clock


@dataclass(frozen=True, eq=False, kw_only=True)
class _Arrival:
    picture: Picture
    monotonic_ns: int
    connection: int


class LiveStream:
    """A camera by its index or a network stream; one that is lost is reached for again, for ever.

    At most `live_queue` frames wait; where more come the oldest goes. Addresses of stored videos,
    which promise their number of frames, are read to their end, and nothing of them is dropped.
    """

    def __init__(self, address: str, settings: ReadFramesSettings) -> None:
        """Raises SourceError where no picture comes for `connect_s`."""
        is_camera = address.isdecimal()
        # Names are recorded; passwords not.
        self.name = f"camera {address}" if is_camera else re.sub(r"(?<=://)[^/]*@", "", address)
        self.warnings: list[str] = []
        self.counts = CameraCounts()
        self._address = address
        self._settings = settings
        self._on_notice: Callable[[str], None] = self.warnings.append
        self._after_ns = 0
        self._queue: deque[_Arrival] = deque()
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._has_ended = False
        self._failure: BaseException | None = None
        self._decoder = Decoder(address)
        first = self._first_picture()
        if first is None:
            self._decoder.close()
            raise SourceError(
                f"{self.name}: expected a camera or stream that gives pictures, got none; "
                "check that it is switched on and reachable"
            )
        self.width, self.height = self._decoder.width, self._decoder.height
        self.fps = usual_fps(self._decoder.fps, settings)
        promised = self._decoder.promised
        self.num_frames = int(promised) if 1 <= promised < _MOST_FRAMES else None
        self._pump = threading.Thread(
            target=self._run, args=(first,), name=f"pump of {self.name}", daemon=True
        )
        self._pump.start()

    @property
    def is_endless(self) -> bool:
        """Whether it has no end but `close`."""
        return self.num_frames is None

    @property
    def num_waiting(self) -> int:
        """Frames that the chain has not taken yet."""
        return len(self._queue)

    def listen(self, on_notice: Callable[[str], None]) -> None:
        """Be told, in the pump's thread, of losses and returns; few different lines."""
        self._on_notice = on_notice

    def resume_after(self, timestamp_ns: int) -> None:
        """Let all capture times be later than this one, of an earlier run."""
        self._after_ns = timestamp_ns

    def __iter__(self) -> Iterator[Frame]:
        """The frames from now on; those that came before count for nothing."""
        if self.is_endless:
            with self._changed:
                self._queue.clear()
                self.counts = CameraCounts(last_arrival_ns=time.monotonic_ns())
        now_ns = time.monotonic_ns()
        clock = CaptureClock(wall_ns=time.time_ns(), monotonic_ns=now_ns, after_ns=self._after_ns)
        frame_index, connection = 0, 0
        while (arrival := self._take()) is not None:
            frame_index += 1
            if arrival.connection != connection:
                connection = arrival.connection
                clock.reconnected()
            self._watch_wall(clock)
            yield Frame(
                frame_index=frame_index,
                timestamp_ns=clock.stamp(
                    monotonic_ns=arrival.monotonic_ns,
                    stream_ns=_stream_ns(arrival.picture.milliseconds),
                ),
                image=arrival.picture.image,
                source=self.name,
            )

    def close(self) -> None:
        """Let go of the device or connection; iteration ends."""
        self._closing.set()
        self._decoder.close()
        with self._changed:
            self.counts.dropped += len(self._queue)
            self._queue.clear()
            self._has_ended = True
            self._changed.notify_all()
        while self._pump.is_alive():  # which may have begun another decoder meanwhile
            self._decoder.close()
            self._pump.join(_FIRST_PAUSE_S)
        self._decoder.close()

    def _take(self) -> _Arrival | None:
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._has_ended)
            if not self._queue:
                if self._failure is not None:
                    raise self._failure
                return None
            self.counts.passed_on += 1
            self._changed.notify_all()
            return self._queue.popleft()

    def _run(self, first: Picture) -> None:
        """The pump: pictures into the queue, whatever becomes of the connection."""
        try:
            self._put(first)
            self._read_on()
        except BaseException as error:
            self._failure = error
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def _read_on(self) -> None:
        while not self._closing.is_set():
            try:
                picture = self._decoder.read(timeout_s=self._settings.silence_s)
                why = "the stream ended"
            except DecodingError as error:
                picture, why = None, str(error)
            if picture is not None:
                self._put(picture)
            elif self.is_endless:
                self._lost(why)
            else:
                return

    def _put(self, picture: Picture) -> None:
        arrival = _Arrival(
            picture=picture,
            monotonic_ns=time.monotonic_ns(),
            connection=self.counts.reconnects,
        )
        with self._changed:
            if not self.is_endless:
                self._changed.wait_for(
                    lambda: len(self._queue) < self._settings.live_queue or self._closing.is_set()
                )
            self.counts.received += 1
            self.counts.last_arrival_ns = arrival.monotonic_ns
            if len(self._queue) >= self._settings.live_queue:
                self._queue.popleft()
                self.counts.dropped += 1
            self._queue.append(arrival)
            self._changed.notify_all()

    def _lost(self, why: str) -> None:
        """Reach for the camera again and again, with longer pauses, none the same."""
        if self._closing.is_set():
            return
        self._on_notice(f"{self.name} is lost: {why}; reaching for it again")
        pause_s, picture = _FIRST_PAUSE_S, None
        while picture is None:
            self._decoder.close()
            if self._closing.wait(pause_s * random.uniform(0.5, 1.0)):
                return
            pause_s = min(2 * pause_s, self._settings.retry_s)
            try:
                self._decoder = Decoder(self._address)
            except OSError:  # no more processes or memory: the system's trouble may pass too
                continue
            picture = self._first_picture()
            if picture is not None and picture.image.shape[:2] != (self.height, self.width):
                with self._changed:
                    self.counts.received += 1
                    self.counts.failed += 1
                self._on_notice(
                    f"{self.name}: its pictures no longer are {self.width}x{self.height} px; set "
                    "it back, or calibrate anew"
                )
                picture = None
        with self._changed:
            self.counts.reconnects += 1
        self._on_notice(f"{self.name} is back")
        self._put(picture)

    def _first_picture(self) -> Picture | None:
        try:
            return self._decoder.read(timeout_s=self._settings.connect_s)
        except DecodingError:
            return None

    def _watch_wall(self, clock: CaptureClock) -> None:
        step_ns = clock.wall_step_ns(wall_ns=time.time_ns(), monotonic_ns=time.monotonic_ns())
        if abs(step_ns) > _LARGEST_STEP_NS:
            self._on_notice(
                "the system's clock was set; capture times go on by the time of the start"
            )


def _stream_ns(milliseconds: float) -> int | None:
    """The stream's own timestamp; None where it gives none."""
    return round(milliseconds * 1e6) if 0 < milliseconds < 1e12 else None
