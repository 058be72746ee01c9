"""Throughput of `stream-dmr batch`: `python benchmarks/backlog.py --videos 4 --engines local ray`.

Copies of the embedded scene, measured with one worker and with two; `--rounds 3` gives medians. The
first video of each worker also pays for its start; `docs/scale.md` has the figures.
"""

import argparse
import csv
import os
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import product
from pathlib import Path
from statistics import median

from stream_dmr.batch.batch import Engine, batch
from stream_dmr.batch.local import LocalEngine
from stream_dmr.batch.manifest import COLUMNS, Job, read_manifest

DEMO = Path(__file__).resolve().parents[1] / "recordings" / "demo"


@contextmanager
def engine_of(name: str, workers: int) -> Iterator[Engine]:
    if name == "local":
        yield LocalEngine(workers)
        return
    os.environ.setdefault("RAY_worker_niceness", "0")  # else Ray's workers wait for all others
    from ray.cluster_utils import Cluster

    from stream_dmr.batch.ray_engine import RayEngine

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    for _ in range(workers - 1):
        cluster.add_node(num_cpus=1)
    with closing(RayEngine(address=cluster.address)) as engine:
        yield engine
    cluster.shutdown()


def write_manifest(path: Path, videos: int) -> None:
    row = {"video": DEMO / "video.mp4", "calibration": DEMO / "calibration.yaml"}
    row |= {"boxes": DEMO / "boxes.txt", "masks": DEMO / "masks"}
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows([row | {"vessel": "demo", "trip": n} for n in range(videos)])


def measure(name: str, workers: int, jobs: list[Job], out: Path) -> float:
    """Print how it went; returns frames/s, the start of the engine left out."""
    load, began = os.getloadavg()[0], time.perf_counter()
    with engine_of(name, workers) as engine:
        ready_s = time.perf_counter() - began
        summary = batch(jobs, out, engine, stop=threading.Event())
    frames = sum(one.num_frames for one in summary.outcomes)
    fish = sum(one.num_fish for one in summary.outcomes)
    in_work = sum(one.elapsed_s for one in summary.outcomes)
    print(
        f"{name}, {workers} workers: {frames} frames, {fish} fish in {summary.elapsed_s:.1f} s, "
        f"{frames / summary.elapsed_s:.2f} frames/s; {in_work:.1f} s in videos; engine ready in "
        f"{ready_s:.1f} s; load {load:.1f}",
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
    rates = defaultdict[tuple[str, int], list[float]](list)
    with tempfile.TemporaryDirectory() as folder:
        manifest = Path(folder) / "manifest.csv"
        write_manifest(manifest, arguments.videos)
        jobs = read_manifest(manifest, config=None, template=str(DEMO / "species.ply"))
        kinds = list(product(arguments.engines, arguments.workers))
        for number, (name, workers) in product(range(arguments.rounds), kinds):
            out = Path(folder) / f"{name}-{workers}-{number}"
            rates[name, workers].append(measure(name, workers, jobs, out))
    for (name, workers), found in rates.items():
        print(f"{name}, {workers} workers: median {median(found):.2f} frames/s")


if __name__ == "__main__":
    sys.exit(main())
