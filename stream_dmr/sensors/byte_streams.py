"""What a receiver of positions sends, as bytes: over TCP, UDP or a serial line."""

import re
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Protocol, runtime_checkable

import serial

from stream_dmr.errors import SourceError

_POLL_S = 0.5  # how long a read waits, so that a run can end
_CONNECT_S = 5.0
_CHUNK_BYTES = 4096
_ADDRESS = re.compile(r"(tcp|udp)://(\[[^\]]+\]|[^:/\s]*):(\d{1,5})/?")
_SERIAL_NAME = re.compile(r"COM\d+", re.IGNORECASE)


@runtime_checkable
class ByteStream(Protocol):
    """An open connection."""

    def read(self) -> bytes:
        """What has come; b"" where nothing came for half a second. OSError where it is lost."""
        ...

    def close(self) -> None:
        """Release it. Idempotent."""
        ...


class ReceiverAddress:
    """Where a receiver is: `tcp://HOST:PORT`, `udp://HOST:PORT` or a serial device."""

    def __init__(self, text: str, *, baud: int) -> None:
        """Raises SourceError where it is none of these. Nothing is opened yet."""
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
        """Connect. Raises OSError where that is not possible now."""
        if self._place is None:
            return _SerialStream(self.text, self._baud)
        protocol, host, port = self._place
        if protocol == "udp":
            return _SocketStream(_bound(host, port), is_stream=False)
        return _SocketStream(
            socket.create_connection((host, port), timeout=_CONNECT_S), is_stream=True
        )


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
