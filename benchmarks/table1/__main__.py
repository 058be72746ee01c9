"""Table 1 of the paper on simulated fish of known lengths: every row on the same frames.

    make table1 [FISH=60] [ROWS=dmr,bfs] [AGAIN=1]

What has been measured is kept in benchmarks/table1/cache, scene by scene: a run that was broken
off goes on, and ROWS with AGAIN measures only those rows again. An hour on two idle cores for all
738 fish, half of it for Adam. With fewer fish the table is printed, not written to
docs/research/table1.md.
"""

import argparse
import os

# Before numpy and torch are imported: the processes are the threads.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import math
import multiprocessing
import time
from pathlib import Path

from benchmarks.table1 import cached_results, tables
from benchmarks.table1.filmed_scene import FISH_PER_SCENE
from benchmarks.table1.methods import METHODS, make_method, measure_scene

ALL_FISH = 738
DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "research" / "table1.md"


def main() -> None:
    """Measure what is missing, then write or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m table1")
    parser.add_argument("--fish", type=int, default=ALL_FISH, help="rounded up to whole scenes")
    parser.add_argument("--rows", default=",".join(METHODS), help=f"some of {', '.join(METHODS)}")
    parser.add_argument("--again", action="store_true", help="measure these rows again")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=cached_results.CACHE)
    arguments = parser.parse_args()
    wanted = arguments.rows.split(",")
    if unknown := set(wanted) - set(METHODS):
        parser.error(f"--rows: expected some of {', '.join(METHODS)}, got {', '.join(unknown)}")
    scenes = range(math.ceil(arguments.fish / FISH_PER_SCENE))
    if arguments.again:
        for method in wanted:
            cached_results.forget(method, cache=arguments.cache)
    _measure_missing(scenes, wanted, arguments.processes, arguments.cache)
    rows: dict[str, list[cached_results.Fish]] = {}
    for method in METHODS:
        rows |= cached_results.load(method, scenes, cache=arguments.cache)
        hours = cached_results.age_hours(method, cache=arguments.cache)
        print(f"{method}: measured up to {hours:.1f} h ago")
    found = tables.evaluations(rows)
    text = tables.markdown(found)
    print(f"\n{text}\n")
    if "dmr" in rows:
        print("worst of ours:", *tables.worst(rows["dmr"]), sep="\n  ")
    if len(scenes) * FISH_PER_SCENE >= ALL_FISH and set(tables.TITLES) <= set(found):
        tables.write(PAGE, text)
        tables.plot(found, DOCS / "images")
        print(f"written to {PAGE}")


def _measure_missing(scenes: range, wanted: list[str], processes: int, cache: Path) -> None:
    """Scene by scene, since filming is shared by all methods."""
    tasks = []
    for scene in scenes:
        missing = [
            method for method in wanted if not cached_results.is_saved(method, scene, cache=cache)
        ]
        if missing:
            tasks.append((scene, missing, cache))
    if any("bfs" in methods for _, methods, _ in tasks):
        make_method("bfs", cache)  # its database, once for all processes
    began = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(min(processes, max(len(tasks), 1))) as pool:
        for done, scene in enumerate(pool.imap_unordered(measure_scene, tasks), start=1):
            elapsed_s = time.perf_counter() - began
            print(f"{elapsed_s:5.0f} s  scene {scene}, {done} of {len(tasks)}", flush=True)


if __name__ == "__main__":
    main()
