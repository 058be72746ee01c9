"""Opens a recording in Rerun's own viewer: in a window, in a browser, or without a screen.

It is given as the absolute path of an .rrd, or as the address of a `LiveView`.
"""

import os
import re
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from rerun.experimental import ViewerClient

from stream_dmr.errors import RecordingError
from stream_dmr.files import writing_to
from stream_dmr.recording.rerun.program import rerun_program

WEB_MEMORY = "512MiB"  # of the server; what is older is dropped
_VIEWER_MEMORY = "4GiB"
_SETTLE_S, _MOST_SETTLES = 1.0, 15
_TERMINAL_COLORS = re.compile(r"\x1b\[[0-9;]*m")


def show(rrd: str) -> None:
    """Open `rrd` in a window; returns when that is closed."""
    with _running([rrd, "--port", "auto", "--memory-limit", _VIEWER_MEMORY]) as process:
        output = process.communicate()[0]
        if process.returncode:
            raise RecordingError(
                f"expected a screen to show the viewer on, got: {_last_line(output)}; "
                "use --web or --screenshot"
            )


def serve(rrd: str, *, port: int) -> None:
    """Serve `rrd` and a viewer for browsers at 127.0.0.1, until interrupted.

    Prints the address. Memory is bounded by WEB_MEMORY, and nobody outside this machine can see it.
    """
    options = ["--serve-web", "--port", "auto", "--web-viewer-port", str(port)]
    with _running([rrd, *options, "--server-memory-limit", WEB_MEMORY]) as process:
        for line in process.stdout or ():
            if match := re.search(r"connect at (http\S+)", _TERMINAL_COLORS.sub("", line)):
                print(f"{match[1]}\nstop with Ctrl-C", flush=True)
        raise RecordingError(f"the viewer's server ended; is port {port} in use? choose another")


def screenshot(rrd: str, png: Path, *, frame_index: int) -> None:
    """Open `rrd` at one frame in a viewer without a screen and save what it shows.

    Needs a Vulkan driver; a software one does (Debian: mesa-vulkan-drivers). Takes some 5 seconds.
    """
    with _headless() as viewer:
        viewer.open([rrd])
        _go_to(viewer, frame_index)
        with writing_to(png):
            png.write_bytes(_settled_picture(viewer))


@contextmanager
def _headless() -> Iterator[ViewerClient]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with _running(["--headless", "--hide-welcome-screen", "--port", str(port)]) as process:
        _wait_for(process)
        yield ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")


def _wait_for(process: subprocess.Popen[str]) -> None:
    """Until the viewer runs, not only listens; RecordingError where it doesn't come up."""
    lines = []
    for line in process.stdout or ():
        lines.append(line)
        if "Headless viewer running" in line:
            return
    raise RecordingError(
        f"expected a viewer without a screen, got: {_last_line(''.join(lines))}; it needs a Vulkan "
        "driver, a software one does (Debian: apt install mesa-vulkan-drivers)"
    )


def _go_to(viewer: ViewerClient, frame_index: int) -> None:
    """Stop at a frame, as soon as enough is loaded for there to be frames."""
    for _ in range(_MOST_SETTLES):
        try:
            return viewer.set_time("frame", sequence=frame_index, play_state="paused")
        except ConnectionError:
            time.sleep(_SETTLE_S)
    raise RecordingError("expected a recording with frames, found none in it")


def _settled_picture(viewer: ViewerClient) -> bytes:
    """What the viewer shows once it has loaded and laid out: two looks that are the same."""
    time.sleep(_SETTLE_S)
    before = viewer.take_screenshot()
    for _ in range(_MOST_SETTLES):
        time.sleep(_SETTLE_S)
        picture = viewer.take_screenshot()
        if picture == before:
            break
        before = picture
    return before


@contextmanager
def _running(options: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """Rerun's program of this very environment, heard on this machine only; ends with us."""
    with (
        TemporaryDirectory() as scratch,  # it leaves files behind
        subprocess.Popen(
            [rerun_program(), *options, "--bind", "127.0.0.1"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "RUST_LOG": "info", "NO_COLOR": "1", "TMPDIR": scratch},
        ) as process,
    ):
        try:
            yield process
        finally:
            process.terminate()


def _last_line(output: str) -> str:
    lines = _TERMINAL_COLORS.sub("", output).strip().splitlines()
    return lines[-1] if lines else "nothing"
