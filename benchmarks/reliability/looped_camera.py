"""A camera whose timestamps begin again at 0 every second or two, over one connection."""

import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

_PACKET_BYTES = 188  # of an MPEG transport stream


class LoopedCamera:
    """Serves `address` until `close`: a transport stream, sent again and again at its pace."""

    def __init__(self, clip: Path, *, duration_s: float) -> None:
        self.num_loops = 0  # that were begun
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
        self._server.daemon_threads = True
        self._server.camera = self  # pyright: ignore[reportAttributeAccessIssue]
        self.data = clip.read_bytes()
        self.pause_s = duration_s * _PACKET_BYTES / len(self.data)
        self.is_open = True
        self.address = f"http://127.0.0.1:{self._server.server_address[1]}/rail.ts"
        Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Send no more."""
        self.is_open = False
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        camera: LoopedCamera = self.server.camera  # pyright: ignore[reportAttributeAccessIssue]
        self.send_response(200)
        self.send_header("Content-Type", "video/mp2t")
        self.end_headers()
        with suppress(OSError):
            while camera.is_open:
                camera.num_loops += 1
                self._send(camera)

    def _send(self, camera: LoopedCamera) -> None:
        due_s = time.monotonic()
        for at in range(0, len(camera.data), _PACKET_BYTES):
            self.wfile.write(camera.data[at : at + _PACKET_BYTES])
            due_s += camera.pause_s
            time.sleep(max(0.0, due_s - time.monotonic()))

    def log_message(self, *_: object) -> None:
        """Say nothing."""
