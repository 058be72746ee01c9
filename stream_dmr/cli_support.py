"""What several commands need: the command as typed, and signals that end a run gently."""

import re
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


def without_password(text: str) -> str:
    """An address without the password in it."""
    return re.sub(r"(?<=://)[^/\s]*@", "", text)


def command_line() -> str:
    """The command as typed, for the recording; passwords are left out."""
    return without_password(shlex.join(["stream-dmr", *sys.argv[1:]]))


class Stop(threading.Event):
    """Set by a signal, which it remembers."""

    signal_number = 0


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Ctrl-C and SIGTERM set the event instead of breaking in; repeated ones change nothing."""
    stop = Stop()

    def on_signal(number: int, frame: FrameType | None) -> None:
        if not stop.is_set():
            stop.signal_number = number
            stop.set()

    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, on_signal) for number in signals]
    try:
        yield stop
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
