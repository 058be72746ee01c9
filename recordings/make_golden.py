"""Makes recordings/golden: a run of the demo's first fish that every change is replayed against.

    make golden

An intended change of numbers is a reviewed change of this folder; what moved is printed.
"""

import shutil
import sys
import tempfile
import threading
from pathlib import Path

from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.replay_recording import replay
from stream_dmr.pipeline.run_options import ReplayOptions, RunOptions
from stream_dmr.simulation import DEMO_SCENE

GOLDEN = Path(__file__).parent / "golden"


def main() -> None:
    """Say what moved since the last time, then replace it."""
    if (GOLDEN / "recording.mcap").exists():
        _print_moved()
    with tempfile.TemporaryDirectory() as folder:
        # From a copy, since a recording says where its inputs lay.
        scene = Path(shutil.copytree(DEMO_SCENE, Path(folder) / "scene"))
        request = RunOptions(
            source=str(scene / "video.mp4"),
            boxes=scene / "boxes.txt",
            masks=scene / "masks",
            calibration=scene / "calibration.yaml",
            out=Path(folder) / "out",
            command="make golden",
        )
        measure_source(request, stop=threading.Event())
        GOLDEN.mkdir(exist_ok=True)
        for name in ("recording.mcap", "lengths.csv"):
            shutil.copy(request.out / name, GOLDEN / name)


def _print_moved() -> None:
    request = ReplayOptions(recordings=[GOLDEN / "recording.mcap"], check=True)
    moved = replay(request, stop=threading.Event()).mismatches
    kinds = sorted({item.kind for item in moved})
    print(f"{len(moved)} fields moved: {', '.join(kinds) or 'none'}", file=sys.stderr)
    for item in moved:
        if item.difference.field in ("length_mm", "status"):
            field, was, now = item.difference
            print(f"  frame {item.frame_index}, fish {item.track_id}, {field}: {was} -> {now}")


if __name__ == "__main__":
    main()
