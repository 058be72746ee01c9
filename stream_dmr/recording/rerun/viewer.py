"""Opens a recording in Rerun's viewer: in a window, in a browser, or without a screen.

`rrd` is the absolute path of an .rrd or the address of a `LiveView`.
"""

import os
import re
import socket
import subprocess
import time
from collections.abc import Generator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from rerun.experimental import ViewerClient

from stream_dmr.errors import RecordingError
from stream_dmr.files import make_folder, replacing
from stream_dmr.recording.frame_images import FrameRestorer, RecordedPictures
from stream_dmr.recording.reading import (
    decoded_messages,
    open_recordings,
    require_messages,
    require_selected,
)
from stream_dmr.recording.rerun.rrd_file import rerun_program
from stream_dmr.recording.rerun.rrd_sink import RrdSink
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import SECOND_TOPICS, TOPICS, RecordingSettings
from stream_dmr.recording.view_geometry import MeshRebuilder
from stream_dmr.recording.whole_records import WholeRecords

WEB_MEMORY = "512MiB"  # of the server; older messages are dropped
_VIEWER_MEMORY = "4GiB"
_SETTLE_S, _MAX_SETTLES = 1.0, 15  # a screenshot takes some 5 s; slower machines get 15
_TERMINAL_COLORS = re.compile(r"\x1b\[[0-9;]*m")


def show(rrd: str) -> None:
    """Open `rrd` in a window and return when it is closed. Raises RecordingError."""
    with _running([rrd, "--port", "auto", "--memory-limit", _VIEWER_MEMORY]) as process:
        output = process.communicate()[0]
        if process.returncode:
            raise RecordingError(
                f"expected a screen to show the viewer on, got: {_last_line(output)}; "
                "use --web or --screenshot"
            )


def serve(rrd: str, *, port: int) -> None:
    """Serve `rrd` and a viewer for browsers at 127.0.0.1, until interrupted.

    Prints the address. Memory is bounded by WEB_MEMORY; other machines can't connect.
    """
    options = ["--serve-web", "--port", "auto", "--web-viewer-port", str(port)]
    with _running([rrd, *options, "--server-memory-limit", WEB_MEMORY]) as process:
        for line in process.stdout or ():
            if match := re.search(r"connect at (http\S+)", _TERMINAL_COLORS.sub("", line)):
                print(f"{match[1]}\nstop with Ctrl-C", flush=True)
        raise RecordingError(
            f"the viewer's server ended; maybe port {port} is in use: choose another with --port"
        )


def screenshot(rrd: str, png: Path, *, frame_index: int) -> None:
    """Save the picture of a viewer without a screen that shows `rrd` at a frame.

    Needs a Vulkan driver, which may be a software driver (Debian: mesa-vulkan-drivers). Takes some
    5 seconds.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with _running(["--headless", "--hide-welcome-screen", "--port", str(port)]) as process:
        if not any("Headless viewer running" in line for line in process.stdout or ()):
            raise RecordingError(
                "expected a viewer without a screen, but it did not start; it needs a Vulkan "
                "driver, a software one does (Debian: apt install mesa-vulkan-drivers)"
            )
        viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        viewer.open([rrd])
        _go_to(viewer, frame_index)
        with replacing(png) as draft:
            draft.write_bytes(_settled_picture(viewer))


def _go_to(viewer: ViewerClient, frame_index: int) -> None:
    """Go to a frame as soon as frames are loaded. Raises RecordingError if there are none."""
    for _ in range(_MAX_SETTLES):
        try:
            return viewer.set_time("frame", sequence=frame_index, play_state="paused")
        except ConnectionError:
            time.sleep(_SETTLE_S)
    raise RecordingError("expected a recording with frames, found none in it")


def _settled_picture(viewer: ViewerClient) -> bytes:
    """PNG of the loaded view: of two equal consecutive screenshots."""
    time.sleep(_SETTLE_S)
    before = viewer.take_screenshot()
    for _ in range(_MAX_SETTLES):
        time.sleep(_SETTLE_S)
        picture = viewer.take_screenshot()
        if picture == before:
            break
        before = picture
    return before


@contextmanager
def _running(options: Sequence[str]) -> Generator[subprocess.Popen[str]]:
    """Run Rerun's program, listening on this machine only, until the context ends."""
    with (
        TemporaryDirectory() as scratch,  # for the files that it leaves behind
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


EVERY_FRAME = RecordingSettings(view_rate_hz=1000.0)


def convert(
    recording: Path,
    rrd: Path,
    *,
    source: FrameRestorer | None = None,
    second_source: FrameRestorer | None = None,
    settings: RecordingSettings = EVERY_FRAME,
    selection: Selection = EVERYTHING,
) -> Sequence[str]:
    """Draw the selected messages of a recording into `rrd`, which can be replayed as well.

    Pictures are those of `source`, and `second_source` of a second camera; without them those in
    the recording. Returns the recording's losses, one line each. Raises RecordingError if the
    recording can't be read, UserError if it has nothing of the selection, SourceError if a picture
    is not the recorded one, OutputError if `rrd` can't be written.
    """
    opened = open_recordings([recording])
    require_messages(opened)
    require_selected(opened, selection)
    second = opened.header.second
    later = selection.shifted(0 if second is None else second.offset_ns)
    records = WholeRecords(
        MeshRebuilder.of(opened),
        source or RecordedPictures(opened, selection),
        second=second,
        of_second=decoded_messages(opened, [*SECOND_TOPICS], later, of=SECOND_TOPICS),
        second_pictures=second_source,
    )
    with (
        replacing(make_folder(rrd.parent) / rrd.name) as draft,
        closing(RrdSink(draft, opened.header, settings)) as sink,
    ):
        for message, payload in decoded_messages(opened, list(TOPICS), selection):
            for record in records.of(message, payload):
                sink.write(record)
        for record in records.rest():
            sink.write(record)
    return opened.warnings
