"""Frames of cameras and streams, with capture times that no step of a clock changes.

Three clocks: the system's wall clock, which may be stepped; its monotonic clock, which is not; and
the stream's own timestamps, which space frames exactly but may jump or begin again.
"""

import random
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from stream_dmr.errors import SourceError
from stream_dmr.files import without_password
from stream_dmr.messages import Frame
from stream_dmr.sources.decoder import DecodedPicture, Decoder, DecodingError
from stream_dmr.sources.source import CameraCounts, ReadFramesSettings, ResumePoint, Source
from stream_dmr.sources.video_file import plausible_fps, promised_frames

_MAX_DELAY_NS = 1_000_000_000  # chosen: a stream time further behind arrival is a new time base
_SLEW_FRAMES = 1024  # chosen: drift of the camera's clock is followed with this time constant


class CaptureClock:
    """Capture times in ns since 1970: strictly increasing, and near the time of arrival.

    The wall clock is read once, at the start; after that, the monotonic clock counts. Frames are
    spaced by the stream's timestamps as long as these lie at most 1 s before the arrival, and not
    after it; otherwise the time base is set again from the arrival. All clocks are arguments.
    """

    def __init__(self, *, wall_ns: int, monotonic_ns: int, after_ns: int = 0) -> None:
        """`after_ns` is the last capture time of an earlier run; every time here is later."""
        self._wall_from_monotonic = wall_ns - monotonic_ns
        self._capture_from_monotonic = max(wall_ns, after_ns + 1) - monotonic_ns
        self._capture_from_stream: int | None = None
        self._last_ns = after_ns

    def stamp(self, *, monotonic_ns: int, stream_ns: int | None) -> int:
        """Capture time of a frame that arrived now; `stream_ns` None: it has no timestamp."""
        arrival_ns = monotonic_ns + self._capture_from_monotonic
        time_ns = arrival_ns if stream_ns is None else self._follow(stream_ns, arrival_ns)
        self._last_ns = max(time_ns, self._last_ns + 1)
        return self._last_ns

    def reconnected(self) -> None:
        """Set the time base again with the next frame: a new connection may count from anywhere."""
        self._capture_from_stream = None

    def wall_step_ns(self, *, wall_ns: int, monotonic_ns: int) -> int:
        """Return by how much the wall clock was stepped since the last call (or the start), ns."""
        step_ns = wall_ns - monotonic_ns - self._wall_from_monotonic
        self._wall_from_monotonic += step_ns
        return step_ns

    def _follow(self, stream_ns: int, arrival_ns: int) -> int:
        if self._capture_from_stream is None:
            self._capture_from_stream = arrival_ns - stream_ns
        error_ns = arrival_ns - (stream_ns + self._capture_from_stream)
        if error_ns < 0 or error_ns > _MAX_DELAY_NS:  # no frame is taken after it arrived
            self._capture_from_stream = arrival_ns - stream_ns
        else:
            self._capture_from_stream += error_ns // _SLEW_FRAMES
        return stream_ns + self._capture_from_stream


_FIRST_PAUSE_S = 0.25  # before the first attempt to reconnect; doubled up to `retry_s`
_CLOCK_STEP_NS = 1_000_000_000  # smaller corrections of the system's clock are not reported
_JITTER = random.Random()  # its own: a user of the library may have seeded `random`


@dataclass(frozen=True, eq=False, kw_only=True)
class _Arrival:
    """A decoded picture, when it arrived, and over which connection (0 is the first)."""

    picture: DecodedPicture
    monotonic_ns: int
    connection: int


class LiveStream(Source):
    """A camera by its index or a network stream; a lost connection is retried until `close`.

    A thread receives pictures into a queue of at most `live_queue`; when it is full, the oldest is
    dropped. Addresses of stored videos, which promise their number of frames, are read to their
    end, and nothing of them is dropped.
    """

    is_live = True

    def __init__(self, address: str, settings: ReadFramesSettings) -> None:
        """Raises SourceError if no picture comes for `connect_s`."""
        is_camera = address.isdecimal()
        # Names are recorded, so user and password are cut out of addresses.
        self.name = f"camera {address}" if is_camera else without_password(address)
        self.warnings: list[str] = []
        self._counts = CameraCounts()
        self._address = address
        self._settings = settings
        self._on_notice: Callable[[str], None] = self.warnings.append
        self._after_ns = 0
        self._queue: deque[_Arrival] = deque()
        self._changed = threading.Condition()  # guards queue and counts
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
        self.fps = plausible_fps(self._decoder.fps, settings)
        self.num_frames = promised_frames(self._decoder.promised)
        self.is_endless = self.num_frames is None  # else the address is that of a stored video
        self._receiver = threading.Thread(
            target=self._receive, args=(first,), name=f"receiver of {self.name}", daemon=True
        )
        self._receiver.start()

    @property
    def counts(self) -> CameraCounts:
        return self._counts

    def resume(self, point: ResumePoint) -> None:
        """Make all capture times later than those of earlier runs."""
        self._after_ns = point.after_ns

    def __iter__(self) -> Iterator[Frame]:
        """The frames from now on; earlier frames of a camera are discarded uncounted."""
        if self.is_endless:
            with self._changed:
                self._queue.clear()
                self._counts = CameraCounts(last_arrival_ns=time.monotonic_ns())
        now_ns = time.monotonic_ns()
        clock = CaptureClock(wall_ns=time.time_ns(), monotonic_ns=now_ns, after_ns=self._after_ns)
        frame_index, connection = 0, 0
        while (arrival := self._dequeue()) is not None:
            frame_index += 1
            if arrival.connection != connection:
                connection = arrival.connection
                clock.reconnected()
            step_ns = clock.wall_step_ns(wall_ns=time.time_ns(), monotonic_ns=time.monotonic_ns())
            if abs(step_ns) > _CLOCK_STEP_NS:
                self._on_notice(
                    "the system's clock was set; capture times continue from the time of the start"
                )
            # A stream may give no time, or one beyond 31 years.
            ms = arrival.picture.milliseconds
            stream_ns = round(ms * 1e6) if 0 < ms < 1e12 else None
            yield Frame(
                frame_index=frame_index,
                timestamp_ns=clock.stamp(monotonic_ns=arrival.monotonic_ns, stream_ns=stream_ns),
                image=arrival.picture.image,
                source=self.name,
            )

    def close(self) -> None:
        """Release the device or connection; the iteration ends."""
        self._closing.set()
        self._decoder.close()
        with self._changed:
            self._counts.dropped += len(self._queue)
            self._queue.clear()
            self._has_ended = True
            self._changed.notify_all()
        while self._receiver.is_alive():  # it may have started another decoder meanwhile
            self._decoder.close()
            self._receiver.join(_FIRST_PAUSE_S)
        self._decoder.close()

    def _dequeue(self) -> _Arrival | None:
        """Wait for the next picture; None at the end. Raises the receiving thread's error."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._has_ended)
            if not self._queue:
                if self._failure is not None:
                    raise self._failure
                return None
            self._counts.passed_on += 1
            self._changed.notify_all()
            return self._queue.popleft()

    def _receive(self, first: DecodedPicture) -> None:
        """The receiving thread: put pictures into the queue, and reconnect if necessary."""
        try:
            self._enqueue(first)
            self._receive_until_closed()
        except BaseException as error:
            self._failure = error
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def _receive_until_closed(self) -> None:
        while not self._closing.is_set():
            try:
                picture = self._decoder.read(timeout_s=self._settings.silence_s)
                reason = "the stream ended"
            except DecodingError as error:
                picture, reason = None, str(error)
            if picture is not None:
                self._enqueue(picture)
            elif self.is_endless:
                self._reconnect(reason)
            else:
                return

    def _enqueue(self, picture: DecodedPicture) -> None:
        arrival = _Arrival(
            picture=picture, monotonic_ns=time.monotonic_ns(), connection=self._counts.reconnects
        )
        with self._changed:
            if not self.is_endless:
                self._changed.wait_for(
                    lambda: len(self._queue) < self._settings.live_queue or self._closing.is_set()
                )
            self._counts.received += 1
            self._counts.last_arrival_ns = arrival.monotonic_ns
            if self._closing.is_set():  # `close` may have emptied the queue already
                self._counts.dropped += 1
                return
            if len(self._queue) >= self._settings.live_queue:
                self._queue.popleft()
                self._counts.dropped += 1
            self._queue.append(arrival)
            self._changed.notify_all()

    def _reconnect(self, reason: str) -> None:
        """Try until the camera delivers a picture of the first one's size, or until `close`.

        The pauses double, and each is shortened at random by up to a half, so that several boxes
        do not ask the same camera in step.
        """
        if self._closing.is_set():
            return
        self._on_notice(f"{self.name} is lost: {reason}; reconnecting")
        pause_s, picture = _FIRST_PAUSE_S, None
        while picture is None:
            self._decoder.close()
            if self._closing.wait(pause_s * _JITTER.uniform(0.5, 1.0)):
                return
            pause_s = min(2 * pause_s, self._settings.retry_s)
            try:
                self._decoder = Decoder(self._address)
            except OSError:  # no process or memory is free: that may pass, too
                continue
            picture = self._first_picture()
            if picture is not None and picture.image.shape[:2] != (self.height, self.width):
                self._refuse_size()
                picture = None
        with self._changed:
            self._counts.reconnects += 1
        self._on_notice(f"{self.name} is back")
        self._enqueue(picture)

    def _refuse_size(self) -> None:
        with self._changed:
            self._counts.received += 1
            self._counts.failed += 1
        self._on_notice(
            f"{self.name}: its pictures no longer are {self.width}x{self.height} px; set it back, "
            "or calibrate again"
        )

    def _first_picture(self) -> DecodedPicture | None:
        try:
            return self._decoder.read(timeout_s=self._settings.connect_s)
        except DecodingError:
            return None
