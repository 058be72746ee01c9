"""A camera on loopback that plays an RTSP session from a file, so that it can be mutated."""

import socketserver
import struct
import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np

_END_OF_SDP = b"--\r\n"  # in the file, between the description and the packets
_SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=rail\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\n"
    "m=video 0 RTP/AVP 26\r\na=rtpmap:26 JPEG/90000\r\na=framerate:15\r\na=control:track\r\n"
)
_ANSWERS = {
    "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY\r\n",
    "DESCRIBE": "Content-Type: application/sdp\r\n",
    "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n",
}
_QUALITY, _WIDTH, _HEIGHT = 80, 160, 120


def write_session(path: Path, *, num_frames: int = 5) -> None:
    """JPEGs in RTP (RFC 2435), one packet each, as RTSP sends them over its own connection."""
    packets = list[bytes]()
    for k in range(num_frames):
        shade = np.full((_HEIGHT, _WIDTH, 3), 8 * k % 256, np.uint8)
        jpeg = cv2.imencode(".jpg", shade, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        scan = jpeg.index(b"\xff\xda") + 2
        pixels = jpeg[scan + int.from_bytes(jpeg[scan : scan + 2]) : -2]
        header = struct.pack(">BBHII", 0x80, 0x80 | 26, k, 6000 * k, 1)
        header += bytes([0, 0, 0, 0, 1, _QUALITY, _WIDTH // 8, _HEIGHT // 8])
        packets.append(struct.pack(">cBH", b"$", 0, len(header + pixels)) + header + pixels)
    path.write_bytes(_SDP.encode() + _END_OF_SDP + b"".join(packets))


class _Session(socketserver.StreamRequestHandler):
    """One client; its server has the `session`."""

    def handle(self) -> None:
        with suppress(OSError):  # a client that has had enough
            self._answer()

    def _answer(self) -> None:
        sdp, _, packets = self.server.session.partition(_END_OF_SDP)  # type: ignore[attr-defined]
        while request := self.rfile.readline().decode(errors="replace").split(" "):
            fields = dict(line.partition(":")[::2] for line in iter(self._line, ""))
            body = sdp if request[0] == "DESCRIBE" else b""
            head = f"RTSP/1.0 200 OK\r\nCSeq:{fields.get('CSeq', ' 0')}\r\n"
            head += f"{_ANSWERS.get(request[0], '')}Content-Length: {len(body)}\r\n\r\n"
            self.wfile.write(head.encode() + body + packets * (request[0] == "PLAY"))
            if request[0] not in _ANSWERS:
                return

    def _line(self) -> str:
        return self.rfile.readline().decode(errors="replace").strip()


@contextmanager
def playing(path: Path) -> Generator[str]:
    """Serve a session, mutated or not, to each who asks; gives the address."""
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), _Session) as server:
        server.daemon_threads = True
        server.session = path.read_bytes()  # type: ignore[attr-defined]
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"rtsp://127.0.0.1:{server.server_address[1]}/rail"
        server.shutdown()
