"""A finished run over a tiny clip: what exports, reports and reviews start from."""

import threading
from pathlib import Path

from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_options import RunOptions
from tests.support.tiny_clip import write_clip

FISH = [[1], [1, 2], [1, 2], [1, 2], [1, 2], [2]]


class StopAt(RunObserver):
    """Sets the event when so many frames are done, and keeps the warnings."""

    def __init__(self, num_frames: int) -> None:
        self.stop, self.warned, self._left = threading.Event(), list[str](), num_frames
        if num_frames == 0:
            self.stop.set()

    def warn(self, line: str) -> None:
        self.warned.append(line)

    def frame_done(self) -> None:
        self._left -= 1
        if self._left == 0:
            self.stop.set()


def request(clip: Path, out: Path, **other: object) -> RunOptions:
    given: dict[str, object] = {
        "source": str(clip / "video.mp4"),
        "out": out,
        "calibration": clip / "calibration.yaml",
        "masks": clip / "masks",
        "template": str(clip / "tiny.ply"),
        "config": clip / "quick.toml",
        "command": f"stream-dmr run --source {clip / 'video.mp4'}",
    }
    return RunOptions(**given | other)  # type: ignore[arg-type]


def measure(folder: Path, **other: object) -> Path:
    """Write a clip of two fish into `folder`, measure it into `folder`/out."""
    clip = folder / "clip"
    write_clip(clip, fish=FISH)
    toml = clip / "tiny.toml"
    toml.write_text(toml.read_text() + '[length]\ntail = "fork"\ntotal_per_fork = 1.05\n')
    config = clip / "quick.toml"
    config.write_text(config.read_text() + "\n[smooth_length]\nmax_std_ratio = 1e9\n")
    measure_source(request(clip, folder / "out", **other), stop=threading.Event())
    return folder / "out"
