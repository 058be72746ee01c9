"""Positions of a receiver that sends: over TCP, UDP or a serial line."""

import random
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from stream_dmr.messages import Frame, Position
from stream_dmr.sensors.byte_streams import ByteStream, LineSplitter, ReceiverAddress
from stream_dmr.sensors.fix_builder import Fix, FixBuilder, PositionCounts
from stream_dmr.sensors.position_source import PositionSource, position
from stream_dmr.sensors.sensors_settings import SensorsSettings
from stream_dmr.sources.capture_clock import CaptureClock

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 30.0  # between attempts to connect
_MAX_WAITING = 100_000  # positions that no frame has passed yet: a day without pictures
_CLOCK_ERROR_S = 5.0  # between this machine's clock and the receiver's, that is worth a word
_JITTER = random.Random()  # its own: a user of the library may have seeded `random`


class PositionReceiver(PositionSource):
    """Receives in a thread of its own, and connects again for as long as the run goes on.

    A receiver that is away when a run begins is a problem that the run tells, and no reason not to
    measure. A position's `timestamp_ns` is when its sentence came, its `utc_ns` what it says.
    """

    def __init__(self, address: str, settings: SensorsSettings) -> None:
        """Raises SourceError where the address is none."""
        self.name = address
        self._address = ReceiverAddress(address, baud=settings.baud)
        self._silence_s = settings.silence_s
        self._builder = FixBuilder(settings, now_ns=time.time_ns)
        self._lock = threading.Lock()
        self._waiting: deque[tuple[int, Fix]] = deque(maxlen=_MAX_WAITING)
        self._clock: CaptureClock | None = None
        self._closing = threading.Event()
        self._on_notice: Callable[[str], None] = lambda line: None
        self._trouble = ""  # why it is not connected
        self._has_told_clock = False
        self._last_frame = 0
        self._opened_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._receive, name="positions", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> PositionCounts:
        """What came so far."""
        with self._lock:
            return replace(self._builder.counts)

    def listen(self, on_notice: Callable[[str], None]) -> None:
        """Call `on_notice` in the receiving thread."""
        self._on_notice = on_notice

    def begin(self, *, after_ns: int) -> None:
        """Positions get capture times as the frames of a camera do."""
        self._clock = CaptureClock(
            wall_ns=time.time_ns(), monotonic_ns=time.monotonic_ns(), after_ns=after_ns
        )

    def take(self, frame: Frame) -> Sequence[Position]:
        """The positions that came up to the time of a frame."""
        self._last_frame = frame.frame_index
        return self._taken(frame.timestamp_ns)

    def finish(self) -> Sequence[Position]:
        """All that came since."""
        return self._taken(None)

    def problems(self) -> list[str]:
        """Why no positions come."""
        counts, now_ns = self.counts, time.monotonic_ns()
        silent_s = (now_ns - (counts.last_arrival_ns or self._opened_ns)) / 1e9
        blind_s = (now_ns - (counts.last_position_ns or self._opened_ns)) / 1e9
        if silent_s > self._silence_s:
            reason = f" ({self._trouble})" if self._trouble else ""
            return [f"the receiver of positions has been silent for {silent_s:.0f} s{reason}"]
        if blind_s > self._silence_s:
            return [f"the receiver gives no position that can be used for {blind_s:.0f} s"]
        return []

    def close(self) -> None:
        """End the thread. Idempotent."""
        self._closing.set()
        self._thread.join()

    def _taken(self, until_ns: int | None) -> list[Position]:
        if self._clock is None:
            return []
        found: list[Position] = []
        with self._lock:
            while self._waiting and (until_ns is None or self._waiting[0][0] <= until_ns):
                timestamp_ns, fix = self._waiting.popleft()
                found.append(position(fix, timestamp_ns=timestamp_ns, frame_index=self._last_frame))
        return found

    def _receive(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._closing.is_set():
            stream = None
            try:
                stream = self._address.open()
                self._connected()
                pause_s = _FIRST_PAUSE_S
                self._read(stream)
            except (OSError, ValueError) as error:
                self._lost(error)
            finally:
                if stream is not None:
                    stream.close()
            if self._closing.wait(pause_s * _JITTER.uniform(0.5, 1.0)):
                return
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)

    def _read(self, stream: ByteStream) -> None:
        """Until the run ends, or the stream is silent for too long: the other side may be gone."""
        splitter, heard_ns = LineSplitter(), time.monotonic_ns()
        while not self._closing.is_set():
            data, now_ns = stream.read(), time.monotonic_ns()
            if data:
                heard_ns = now_ns
            elif now_ns - heard_ns > 2 * self._silence_s * 1e9:
                raise TimeoutError(f"nothing came for {(now_ns - heard_ns) / 1e9:.0f} s")
            for line in splitter.lines(data):
                self._take_line(line, now_ns)

    def _take_line(self, line: bytes, now_ns: int) -> None:
        with self._lock:
            fix = self._builder.take(line, arrival_ns=now_ns)
            self._builder.counts.last_arrival_ns = now_ns
            if fix is None:
                return
            self._builder.counts.last_position_ns = now_ns
            if self._clock is not None:
                self._waiting.append((self._clock.stamp(monotonic_ns=now_ns, stream_ns=None), fix))
        self._tell_clock(fix)

    def _tell_clock(self, fix: Fix) -> None:
        """Say once that this machine's clock and the receiver's differ."""
        if self._has_told_clock or fix.utc_ns is None:
            return
        ahead_s = (time.time_ns() - fix.utc_ns) / 1e9
        if abs(ahead_s) > _CLOCK_ERROR_S:
            self._has_told_clock = True
            word = "ahead of" if ahead_s > 0 else "behind"
            self._on_notice(
                f"this machine's clock is {abs(ahead_s):.0f} s {word} the receiver of positions; "
                "the UTC of a fish is the receiver's"
            )

    def _connected(self) -> None:
        if self._trouble:
            self._on_notice(f"the receiver of positions {self.name} is back")
            with self._lock:
                self._builder.counts.reconnects += 1
        self._trouble = ""

    def _lost(self, error: Exception) -> None:
        if not self._trouble:
            self._on_notice(f"the receiver of positions {self.name} is lost: {error}; reconnecting")
        self._trouble = str(error)
