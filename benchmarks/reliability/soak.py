"""`make soak`: a looped live stream for an hour; what grows, and what is dropped.

    python -m benchmarks.reliability.soak --minutes 60 --fps 15 [--scene FOLDER]

The stream is 1280 x 960 and shows two fish in every frame, unless another scene is given.
"""

import argparse
import itertools
import json
import shutil
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np
from prometheus_client.parser import text_string_to_metric_families

from benchmarks.fit_speed.chain_speed import write_clip
from benchmarks.reliability.camera_run import Measurement, resources

_WARM_UP = 1 / 3  # of the time, that counts for nothing: memory fills up for twenty minutes
_EVERY_S = 5.0
_A_WHILE_S = 600.0


def main() -> None:
    """Measure, sample, and fit a line through the memory."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--fps", type=int, default=15)
    parser.add_argument("--scene", type=Path)
    arguments = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    scene = arguments.scene or folder / "scene"
    if not arguments.scene:
        scene.mkdir()
        write_clip(scene, num_frames=60, num_fish=2)
    run = Measurement(folder, scene, fps=arguments.fps)
    run.camera.start()
    run.start()
    assert run.process is not None
    try:
        run.wait_for("begin")
        began, samples = time.monotonic(), []
        while (now := time.monotonic() - began) < 60 * arguments.minutes:
            samples.append({"s": now} | resources(run.process.pid))
            time.sleep(_EVERY_S)
        metrics = metrics_of(run.port)
    finally:
        run.process.terminate()
        run.process.wait()
        run.camera.lose()
    print(json.dumps(figures_of(samples, metrics, arguments.minutes, arguments.fps)), flush=True)
    shutil.rmtree(folder)


def metrics_of(port: int) -> dict[str, float]:
    """What the run says of itself at the end."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return {
            " ".join([sample.name, *sample.labels.values()]): sample.value
            for family in families
            for sample in family.samples
        }


def figures_of(samples: list[dict], metrics: dict[str, float], minutes: float, fps: int) -> dict:
    """Slope of the memory after the warm-up, ranges of the rest, frames and fish."""
    warm = [one for one in samples if one["s"] > _WARM_UP * samples[-1]["s"]]
    hours = np.array([one["s"] for one in warm]) / 3600
    slope = np.polyfit(hours, [one["rss_mb"] for one in warm], 1)[0] if len(warm) > 2 else np.nan
    ranges = {
        name: [min(one[name] for one in warm), max(one[name] for one in warm)]
        for name in ("rss_mb", "descriptors", "threads", "children")
    }
    camera = {
        outcome: metrics[f"stream_dmr_camera_frames_total {outcome}"]
        for outcome in ("received", "passed_on", "dropped", "failed")
    }
    fish = sum(value for name, value in metrics.items() if name.startswith("stream_dmr_fish"))
    return {
        "minutes": minutes,
        "fps": fps,
        "memory slope MB/h": round(float(slope), 1),
        "memory MB in each ten minutes, lowest and median": _memory_by_while(samples),
        "ranges": ranges,
        "frames": camera,
        "fish": fish,
    }


def _memory_by_while(samples: list[dict]) -> list[tuple[float, float]]:
    """A frame that waits takes 4 MB, so single samples say little."""
    whiles = itertools.groupby(samples, key=lambda one: one["s"] // _A_WHILE_S)
    parts = [[one["rss_mb"] for one in some] for _, some in whiles]
    return [(round(min(part)), round(float(np.median(part)))) for part in parts]


if __name__ == "__main__":
    main()
