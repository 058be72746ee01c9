"""Tells systemd that the service is ready, and that it is alive.

The protocol of sd_notify(3): a line to the datagram socket that NOTIFY_SOCKET names.
"""

import os
import socket
import threading
from collections.abc import Callable
from contextlib import suppress


class SystemdWatchdog:
    """Sends READY at once, then WATCHDOG twice per interval while `is_alive` returns True.

    The interval is WATCHDOG_USEC. Without a NOTIFY_SOCKET it does nothing.
    """

    def __init__(self, is_alive: Callable[[], bool]) -> None:
        self._is_alive = is_alive
        self._ended = threading.Event()
        interval_s = _microseconds("WATCHDOG_USEC") / 1e6
        notify("READY=1")
        self._thread = threading.Thread(
            target=self._run, args=(interval_s / 2,), name="watchdog", daemon=True
        )
        if interval_s > 0:
            self._thread.start()

    def close(self) -> None:
        """Send STOPPING, and end."""
        notify("STOPPING=1")
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self, pause_s: float) -> None:
        while not self._ended.is_set():
            if self._is_alive():
                notify("WATCHDOG=1")
            self._ended.wait(pause_s)


def notify(line: str) -> None:
    """Send a line to systemd, where it started this process."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.connect("\0" + address[1:] if address.startswith("@") else address)
        sender.sendall(line.encode())


def _microseconds(name: str) -> int:
    value = os.environ.get(name, "0")
    return int(value) if value.isdecimal() else 0
