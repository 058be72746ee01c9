"""A picture of an .rrd as Rerun shows it, without a screen."""

import socket
import sysconfig
import time
from pathlib import Path

from rerun.experimental import ViewerClient

_SETTLE_S = 3.0


def screenshot(rrd: Path, png: Path, *, frame_index: int) -> None:
    """Open `rrd` in a headless viewer at one frame and save what it shows.

    Needs a Vulkan driver; a software one does (Debian: mesa-vulkan-drivers). Takes some 5 seconds.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = Path(sysconfig.get_path("scripts")) / "rerun"  # of this very environment
    viewer = ViewerClient.spawn(
        headless=True, port=port, hide_welcome_screen=True, executable_path=str(program)
    )
    try:
        viewer.open([str(rrd.resolve())])
        time.sleep(_SETTLE_S)  # the viewer loads and lays out in its own time
        viewer.set_time("frame", sequence=frame_index, play_state="paused")
        time.sleep(_SETTLE_S)
        png.write_bytes(viewer.take_screenshot())
    finally:
        viewer.quit()
