"""Read positions from files and receivers."""

import csv
import random
import re
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Protocol, runtime_checkable

import serial

from stream_dmr.errors import SourceError, reason_of
from stream_dmr.messages import Frame, Position
from stream_dmr.sources.live_stream import CaptureClock
from stream_dmr.sources.positions import (
    Fix,
    FixBuilder,
    JumpGate,
    PositionCounts,
    PositionSource,
    position,
)
from stream_dmr.sources.sensors_settings import SensorsSettings, utc_ns_of

_CSV_COLUMNS = ("time_utc", "latitude", "longitude")
_OPTIONAL_COLUMNS = ("speed_knots", "course_deg")
_MAX_LINE_BYTES = 4096  # chosen: a sentence has 82, a row of any table hardly more than that


class PositionFile(PositionSource):
    """Positions of a file, read as frames pass, so that it may be longer than memory is large.

    A `.csv` has the columns time_utc (ISO 8601), latitude, longitude and perhaps speed_knots and
    course_deg; any other file is read as lines of NMEA 0183, whose RMC or GGA have the time.
    """

    def __init__(self, path: Path, settings: SensorsSettings, *, is_since_1970: bool) -> None:
        """`is_since_1970`: the frames have times of day; those of a video begin with 0.

        Raises SourceError if the file has no position, or if a video's start is not known.
        """
        zero_ns = settings.offset_ns if is_since_1970 else settings.zero_utc_ns
        if zero_ns is None:
            raise SourceError(
                f"--nmea {path}: expected to know when the video began, got no [sensors] start_utc"
                '; add it to the file of --config, such as start_utc = "2026-11-22T06:00:00Z"'
            )
        self.name = path.name
        self._path, self._zero_ns = path, zero_ns
        self._max_gap_ns = round(settings.max_gap_s * 1e9)
        reference_ns = None if is_since_1970 else zero_ns
        self._builder = FixBuilder(settings, now_ns=lambda: reference_ns)
        self._gate = JumpGate(settings.max_speed_knots)  # of a CSV
        self._file = _opened(path)
        self._positions = self._in_order()
        self._next = next(self._positions, None)
        self._last_frame = 0
        self._is_begun = False
        if self._next is None:
            self.close()
            raise SourceError(
                f"--nmea {path}: expected positions (RMC or GGA with dates, or CSV with "
                f"{','.join(_CSV_COLUMNS)}), found none: {self.counts.left_out() or 'it is empty'}"
            )

    @property
    def counts(self) -> PositionCounts:
        return self._builder.counts

    def take(self, frame: Frame) -> Sequence[Position]:
        """The positions up to a frame; before the first frame only the last position."""
        found: list[Position] = []
        self._last_frame = frame.frame_index
        while self._next is not None and self._next[0] <= frame.timestamp_ns:
            found.append(self._message(self._next))
            self._next = next(self._positions, None)
        if not self._is_begun:
            self._is_begun = True
            found = found[-1:]
            if found and frame.timestamp_ns - found[0].timestamp_ns > self._max_gap_ns:
                return []
        return found

    def finish(self) -> Sequence[Position]:
        """The next position, if any, for interpolation before it."""
        return [] if self._next is None else [self._message(self._next)]

    def close(self) -> None:
        self._file.close()

    def _message(self, timed: tuple[int, Fix]) -> Position:
        return position(timed[1], timestamp_ns=timed[0], frame_index=self._last_frame)

    def _in_order(self) -> Iterator[tuple[int, Fix]]:
        """Time on the clock of the frames, increasing, and fix; others are counted as jumps."""
        last_ns: int | None = None
        waiting: tuple[int, Fix] | None = None  # a wrong first date shows in the next position
        is_csv = self._path.suffix.lower() == ".csv"
        sentences = map(self._builder.take, self._lines())
        for fix in self._csv_fixes() if is_csv else filter(None, sentences):
            time_ns = (fix.utc_ns or 0) - self._zero_ns
            if waiting is not None and time_ns > waiting[0]:
                last_ns = waiting[0]
                yield waiting
            elif waiting is not None:
                self._leave_out()
            waiting = time_ns, fix
            if last_ns is not None and time_ns <= last_ns:
                self._leave_out()
                waiting = None
        if waiting is not None:
            yield waiting

    def _lines(self) -> Iterator[bytes]:
        """The lines of the file. Raises SourceError at a line that does not end."""
        while line := self._file.readline(_MAX_LINE_BYTES + 1):
            if len(line) > _MAX_LINE_BYTES:
                self.close()
                raise SourceError(
                    f"--nmea {self._path}: expected lines of {_MAX_LINE_BYTES} bytes at most, got "
                    "a longer one; give a text file of sentences or a CSV"
                )
            yield line

    def _leave_out(self) -> None:
        self.counts.positions -= 1
        self.counts.jumps += 1

    def _csv_fixes(self) -> Iterator[Fix]:
        reader = csv.DictReader(line.decode("utf-8-sig", "replace") for line in self._lines())
        missing = [name for name in _CSV_COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            self.close()
            raise SourceError(
                f"--nmea {self._path}: expected the columns {','.join(_CSV_COLUMNS)} (and perhaps "
                f"{','.join(_OPTIONAL_COLUMNS)}), got {','.join(reader.fieldnames or ()) or 'none'}"
            )
        for row in reader:
            self.counts.sentences += 1
            fix = _csv_fix(row)
            if fix is None:
                self.counts.unreadable += 1
            elif not self._gate.lets_pass(fix, fix.utc_ns or 0):
                self.counts.jumps += 1
            else:
                self.counts.positions += 1
                yield fix


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise SourceError(
            f"--nmea {path}: expected a file of positions, got: {reason_of(error)}"
        ) from error


def _csv_fix(row: dict[str, str]) -> Fix | None:
    """The position of a row; None if a cell is no time or no place on the earth."""
    try:
        optional = {name: float(row[name]) for name in _OPTIONAL_COLUMNS if row.get(name)}
        latitude, longitude = float(row["latitude"]), float(row["longitude"])
        utc_ns = utc_ns_of(row["time_utc"])
    except (ValueError, TypeError):
        return None
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        return None
    return Fix(utc_ns=utc_ns, latitude=latitude, longitude=longitude, **optional)


_POLL_S = 0.5  # how long a read waits, so that a run can end
_CONNECT_S = 5.0
_CHUNK_BYTES = 4096
_ADDRESS = re.compile(r"(tcp|udp)://(\[[^\]]+\]|[^:/\s]*):(\d{1,5})/?")
_SERIAL_NAME = re.compile(r"COM\d+", re.IGNORECASE)


@runtime_checkable
class ByteStream(Protocol):
    """An open connection."""

    def read(self) -> bytes:
        """Received bytes; b"" if nothing came for half a second. OSError if the link is lost."""
        ...

    def close(self) -> None:
        """Release it. Idempotent."""
        ...


class ReceiverAddress:
    """Address of a receiver: `tcp://HOST:PORT`, `udp://HOST:PORT` or a serial device."""

    def __init__(self, text: str, *, baud: int) -> None:
        """Raises SourceError for another kind of address. Nothing is opened yet."""
        self.text, self._baud = text, baud
        match = _ADDRESS.fullmatch(text)
        is_address = match is not None and 0 < int(match[3]) < 65536
        self._place = (match[1], match[2].strip("[]"), int(match[3])) if match else None
        if not (is_address or is_serial_device(text)):
            raise SourceError(
                f"--nmea {text}: expected a file, tcp://HOST:PORT, udp://HOST:PORT or a serial "
                "device, found nothing there; check the path"
            )

    def open(self) -> ByteStream:
        """Connect. Raises OSError if that is not possible now."""
        if self._place is None:
            return _SerialStream(self.text, self._baud)
        protocol, host, port = self._place
        if protocol == "udp":
            return _SocketStream(_bound(host, port), is_stream=False)
        connection = socket.create_connection((host, port), timeout=_CONNECT_S)
        return _SocketStream(connection, is_stream=True)


def is_serial_device(text: str) -> bool:
    """True for the name of a serial line."""
    return Path(text).is_char_device() or bool(_SERIAL_NAME.fullmatch(text))


def _bound(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    made = socket.socket(family, socket.SOCK_DGRAM)
    try:
        made.bind((host, port))
    except BaseException:
        made.close()
        raise
    return made


class _SocketStream:
    def __init__(self, connection: socket.socket, *, is_stream: bool) -> None:
        self._socket, self._is_stream = connection, is_stream
        connection.settimeout(_POLL_S)

    def read(self) -> bytes:
        try:
            data = self._socket.recv(1 << 16 if not self._is_stream else _CHUNK_BYTES)
        except TimeoutError:
            return b""
        if not data and self._is_stream:
            raise ConnectionResetError("the other side closed the connection")
        return data if self._is_stream else data + b"\n"  # a datagram ends a sentence

    def close(self) -> None:
        self._socket.close()


class _SerialStream:
    def __init__(self, device: str, baud: int) -> None:
        self._port = serial.Serial(device, baud, timeout=_POLL_S)

    def read(self) -> bytes:
        return self._port.read(max(1, min(self._port.in_waiting, _CHUNK_BYTES)))

    def close(self) -> None:
        with suppress(OSError):
            self._port.close()


class LineSplitter:
    """Cuts bytes into lines; a line that does not end is given up."""

    def __init__(self, max_bytes: int = 1024) -> None:
        self._max_bytes = max_bytes
        self._rest = b""

    def lines(self, data: bytes) -> Iterator[bytes]:
        """The lines that are complete with these bytes."""
        *complete, self._rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        yield from (line for line in complete if line)
        if len(self._rest) > self._max_bytes:
            yield self._rest
            self._rest = b""


_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 30.0  # between attempts to connect
_MAX_WAITING = 100_000  # positions that no frame has passed yet: a day without pictures
_CLOCK_ERROR_S = 5.0  # between this machine's clock and the receiver's, that is worth a word
_JITTER = random.Random()  # its own: a user of the library may have seeded `random`


class PositionReceiver(PositionSource):
    """Receives in a thread of its own, and reconnects as long as the run lasts.

    A receiver that is away when a run begins is reported as a problem; the run measures without it.
    A position's `timestamp_ns` is when its sentence came, its `utc_ns` the sentence's own time.
    """

    def __init__(self, address: str, settings: SensorsSettings) -> None:
        """Raises SourceError for an invalid address."""
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
        self._last_frame = frame.frame_index
        return self._taken(frame.timestamp_ns)

    def finish(self) -> Sequence[Position]:
        return self._taken(None)

    def problems(self) -> list[str]:
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
                if self._trouble:
                    self._on_notice(f"the receiver of positions {self.name} is back")
                    with self._lock:
                        self._builder.counts.reconnects += 1
                self._trouble, pause_s = "", _FIRST_PAUSE_S
                self._read(stream)
            except (OSError, ValueError) as error:
                if not self._trouble:
                    lost = f"the receiver of positions {self.name} is lost: {error}"
                    self._on_notice(f"{lost}; reconnecting")
                self._trouble = str(error)
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
