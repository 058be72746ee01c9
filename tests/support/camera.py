"""A camera on loopback: an RTSP server that can be taken away and brought back."""

import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

PYTHON = "/usr/bin/python3"  # Debian's own, which has the bindings of its packages
NEEDS = (
    "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import Gst; "
    "Gst.init(None); assert Gst.ElementFactory.find('rtpjpegpay')"
)


def require_server() -> None:
    """Skip where Debian's packages for an RTSP server are not installed."""
    try:
        subprocess.run([PYTHON, "-W", "ignore", "-c", NEEDS], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip(
            "needs an RTSP server: apt install python3-gi gir1.2-gst-rtsp-server-1.0 "
            "gstreamer1.0-plugins-good gstreamer1.0-plugins-bad"
        )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Camera:
    """Serves `address` between `start` and `lose`."""

    def __init__(self, *options: str) -> None:
        self.options = options
        self.port = free_port()
        self.address = f"rtsp://127.0.0.1:{self.port}/rail"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, *options: str) -> None:
        program = Path(__file__).with_name("rtsp_server.py")
        command = [PYTHON, str(program), str(self.port), *(options or self.options)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"serving\n"

    def lose(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def freeze(self) -> None:
        """The connection stands, and no byte comes any more; until `thaw`."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    @contextmanager
    def silent(self) -> Iterator[socket.socket]:
        """Where it was, connections are accepted and nothing ever comes."""
        with socket.create_server(("127.0.0.1", self.port)) as server:
            server.settimeout(60.0)
            yield server


@contextmanager
def camera(*options: str) -> Iterator[Camera]:
    served = Camera(*options)
    try:
        served.start()
        yield served
    finally:
        served.lose()
