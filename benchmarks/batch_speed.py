"""How fast `stream-dmr batch` is.

    python -m benchmarks.batch_speed --videos 4 --engines local ray [--rounds 3]

Copies of the bundled scene with their masks, and all of them in one raw video; with one worker and
with two. With more rounds it prints medians. The first video of each worker also pays for its
start. Figures: docs/research/batch-speed.md.
"""

import argparse
import csv
import os
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from itertools import product
from pathlib import Path
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np

from stream_dmr.batch.driver import Engine, run_batch
from stream_dmr.batch.engines import LocalEngine
from stream_dmr.batch.manifest import COLUMNS, Job, read_manifest
from stream_dmr.simulation import DEMO_SCENE


class Backlog(NamedTuple):
    """What there is to do."""

    name: str
    jobs: list[Job]
    num_frames: int  # of all videos


@contextmanager
def engine_of(name: str, workers: int) -> Iterator[Engine]:
    if name == "local":
        yield LocalEngine(workers)
        return
    os.environ.setdefault("RAY_worker_niceness", "0")  # else Ray's workers wait for all others
    from ray.cluster_utils import Cluster

    from stream_dmr.batch.engines import RayEngine

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    for _ in range(workers - 1):
        cluster.add_node(num_cpus=1)
    with closing(RayEngine(address=cluster.address)) as engine:
        yield engine
    cluster.shutdown()


def backlogs(folder: Path, videos: int) -> Iterator[Backlog]:
    """So many videos with masks; one raw video as long as all of them."""
    masks = {"boxes": DEMO_SCENE / "boxes.txt", "masks": DEMO_SCENE / "masks"}
    copies = [folder / f"{number}.mp4" for number in range(videos)]  # a batch takes each video once
    for copy in copies:
        copy.write_bytes((DEMO_SCENE / "video.mp4").read_bytes())
    with_masks = [{"video": copy} | masks for copy in copies]
    num_frames = write_repeated(folder / "long.mp4", DEMO_SCENE / "video.mp4", times=videos)
    yield Backlog("masks", jobs_of(folder / "masks.csv", with_masks), num_frames)
    raw = jobs_of(folder / "raw.csv", [{"video": folder / "long.mp4"}])
    yield Backlog("raw", raw, num_frames)


def jobs_of(manifest: Path, rows: Sequence[Mapping[str, object]]) -> list[Job]:
    """The jobs of these videos of the bundled scene, by a manifest."""
    with manifest.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for number, row in enumerate(rows):
            of_all = {
                "calibration": DEMO_SCENE / "calibration.yaml",
                "vessel": "demo",
                "trip": number,
            }
            writer.writerow({**row, **of_all})
    return read_manifest(manifest, config=None, template=str(DEMO_SCENE / "species.ply"))


def write_repeated(path: Path, video: Path, *, times: int) -> int:
    """A video, repeated; returns the number of frames."""
    source = cv2.VideoCapture(str(video))
    frames = list[np.ndarray]()
    while (read := source.read())[0]:
        frames.append(read[1])
    height, width = frames[0].shape[:2]
    fps, codec = source.get(cv2.CAP_PROP_FPS), cv2.VideoWriter.fourcc(*"mp4v")
    target = cv2.VideoWriter(str(path), codec, fps, (width, height))
    for frame in frames * times:
        target.write(frame)
    target.release()
    return len(frames) * times


def measure(name: str, workers: int, work: Backlog, out: Path) -> float:
    """Print how it went; returns frames/s, the start of the engine left out."""
    load, began = os.getloadavg()[0], time.perf_counter()
    with engine_of(name, workers) as engine:
        ready_s = time.perf_counter() - began
        stop = threading.Event()
        summary = run_batch(work.jobs, out, engine, stop=stop)
    frames = work.num_frames
    fish = sum(one.num_fish for one in summary.outcomes)
    in_work = sum(one.elapsed_s for one in summary.outcomes)
    print(
        f"{work.name}, {name}, {workers} workers: {frames} frames, {fish} fish in "
        f"{summary.elapsed_s:.1f} s, {frames / summary.elapsed_s:.2f} frames/s; "
        f"{in_work:.1f} s in videos; engine ready in {ready_s:.1f} s; load {load:.1f}",
        flush=True,
    )
    return frames / summary.elapsed_s


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--videos", type=int, default=4)
    parser.add_argument("--engines", nargs="+", default=["local"])
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--rounds", type=int, default=1, help="of all, in turn; then medians")
    arguments = parser.parse_args()
    speeds = defaultdict[tuple[str, str, int], list[float]](list)
    with tempfile.TemporaryDirectory() as folder:
        works = list(backlogs(Path(folder), arguments.videos))
        kinds = list(product(works, arguments.engines, arguments.workers))
        for number, (work, name, workers) in product(range(arguments.rounds), kinds):
            if work.name == "raw" and (name, workers) != ("local", 1):
                continue  # one video keeps one worker busy, wherever
            out = Path(folder) / f"{work.name}-{name}-{workers}-{number}"
            speed = measure(name, workers, work, out)
            speeds[work.name, name, workers].append(speed)
    for (what, name, workers), found in speeds.items():
        print(f"{what}, {name}, {workers} workers: median {median(found):.2f} frames/s")


if __name__ == "__main__":
    sys.exit(main())
