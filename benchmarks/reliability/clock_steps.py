"""The wall clock stepped by an hour, forth and back, while a camera is measured, and a restart.

python -m benchmarks.reliability.clock_steps     # loads disturb.c into itself
"""

import argparse
import ctypes
import json
import os
import subprocess
import sys
import threading
from itertools import pairwise
from pathlib import Path

from benchmarks.reliability.failing_writes import build

HOUR_NS = 3600 * 10**9
_STEPS_NS = [0, HOUR_NS, -HOUR_NS, 0, -HOUR_NS]  # off the true time; the last one at the restart
_PAUSE_S = 6.0


def clock_steps(folder: Path) -> dict[str, object]:
    """Figures, from a process of its own; why not, where that can't be."""
    folder.mkdir(parents=True)
    library = build(folder)
    if library is None:
        return {"skipped": "needs a C compiler: apt install gcc"}
    command = [sys.executable, "-m", "benchmarks.reliability.clock_steps", "--folder", str(folder)]
    environment = os.environ | {"LD_PRELOAD": str(library), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure, step, start again, and look at what was recorded."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path, required=True)
    folder = parser.parse_args().folder
    from benchmarks.reliability.camera_run import QUICK, write_pictures
    from benchmarks.reliability.small_scene import write_small_scene
    from tests.support.camera import Camera, free_port

    scene = write_small_scene(folder / "scene")
    (folder / "pictures").mkdir()
    write_pictures(scene / "video.mp4", folder / "pictures")
    (folder / "config.toml").write_text(QUICK.format(port=free_port()))
    camera = Camera("--jpegs", str(folder / "pictures"), "--fps", "15")
    camera.start()
    notices = measure(folder, camera.address, _STEPS_NS[:-1])
    notices += measure(folder, camera.address, _STEPS_NS[-1:])
    camera.lose()
    print(json.dumps(figures_of(folder / "out") | {"notices of steps": len(notices)}), flush=True)


def measure(folder: Path, address: str, steps_ns: list[int]) -> list[str]:
    """A run with the clock off by each of these for some seconds; what was said of the clock."""
    from stream_dmr.pipeline.measure_source import measure_source
    from stream_dmr.pipeline.run_observer import RunObserver
    from stream_dmr.pipeline.run_options import RunOptions

    library, stop, has_begun = ctypes.CDLL(None), threading.Event(), threading.Event()
    library.disturb_clock.argtypes = [ctypes.c_longlong]
    library.disturb_clock(steps_ns[0])
    said: list[str] = []

    class Listening(RunObserver):
        def warn(self, line: str) -> None:
            said.extend([line] if "clock was set" in line else [])

        def begin(self, num_frames: int | None) -> None:
            has_begun.set()

    def step() -> None:
        has_begun.wait()
        for step_ns in steps_ns:
            library.disturb_clock(step_ns)
            stop.wait(_PAUSE_S)
        stop.set()

    stepping = threading.Thread(target=step)
    stepping.start()
    request = RunOptions(
        source=address,
        out=folder / "out",
        calibration=folder / "scene" / "calibration.yaml",
        template=str(folder / "scene" / "species.ply"),
        config=folder / "config.toml",
    )
    measure_source(request, stop=stop, observer=Listening())
    stepping.join()
    return said


def figures_of(out: Path) -> dict[str, object]:
    """Whether times and numbers only go on, from segment to segment."""
    from benchmarks.reliability.kills import messages
    from stream_dmr.messages import Frame

    segments = [
        [(frame.frame_index, frame.timestamp_ns) for frame in messages(path, Frame)]
        for path in sorted(out.glob("*.mcap"))
    ]
    frames = [frame for segment in segments for frame in segment]
    back = sum(a[1] >= b[1] for a, b in pairwise(frames))
    disordered = sum(a[0] >= b[0] for a, b in pairwise(frames))
    longest_s = max(b[1] - a[1] for segment in segments for a, b in pairwise(segment)) / 1e9
    return {
        "steps of an hour or two": len(_STEPS_NS) - 1,
        "segments": len(segments),
        "frames": len(frames),
        "capture times that go back": back,
        "frames out of order": disordered,
        "longest from frame to frame within a segment, s": round(longest_s, 2),
    }


if __name__ == "__main__":
    main()
