"""Serves the view of a run while it measures."""

import socket
import time
from contextlib import suppress
from queue import Empty, Full, Queue
from threading import Event, Thread

import rerun as rr

from stream_dmr.errors import OutputError
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.record import Record
from stream_dmr.recording.rerun.rrd_sink import log_run, new_stream
from stream_dmr.recording.rerun.scene_drawing import SceneDrawing
from stream_dmr.recording.topics import RecordingSettings

_PORT = 9876  # Rerun's default
_MEMORY = "256MiB"  # of the server, for viewers that connect late; older messages are dropped
_MAX_QUEUED = 128  # messages, some ten frames; beyond that messages are not shown
_SEND_S = 0.2
_CLOSE_TIMEOUT_S = 2.0  # a viewer that hangs is not waited for any longer


class LiveView:
    """Serves the view at `address`, on this machine only.

    It can neither slow down nor stop the run: messages that it has no time for are not shown, and
    after an error of its own it shows nothing more.
    """

    name = "live view"

    def __init__(self, header: RunHeader, settings: RecordingSettings) -> None:
        self._queue: Queue[Record] = Queue(_MAX_QUEUED)
        self._stop = Event()
        port = _free_port()
        self.address = f"rerun+http://127.0.0.1:{port}/proxy"
        sink = rr.GrpcServerSink("127.0.0.1", port, server_memory_limit=_MEMORY)
        self._rec = new_stream(sink, header)
        log_run(self._rec, header)
        self._drawing = SceneDrawing(self._rec, header, settings)
        self._thread = Thread(target=self._draw_all, name="live", daemon=True)
        self._thread.start()

    def write(self, record: Record) -> None:
        """Show a record if the queue has room for it."""
        with suppress(Full):
            self._queue.put_nowait(record)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(_CLOSE_TIMEOUT_S)

    def _draw_all(self) -> None:
        with suppress(Exception):
            send_at = time.monotonic()
            while not (self._stop.is_set() and self._queue.empty()):
                with suppress(Empty):
                    self._drawing.draw(self._queue.get(timeout=_SEND_S))
                if time.monotonic() >= send_at:
                    self._drawing.send()
                    send_at = time.monotonic() + _SEND_S
            self._drawing.send()
        self._rec.disconnect()


def _free_port() -> int:
    """Rerun's default port, or any free port. Raises OutputError if there is none."""
    for port in (_PORT, 0):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return probe.getsockname()[1]
    raise OutputError("--live: expected a free port to serve the view at, found none")
