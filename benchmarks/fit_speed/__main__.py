"""How fast the fit is, beside `adam` and DEODR: tables and a plot in docs/research/fit-speed.md.

    python -m benchmarks.fit_speed [--targets N] [--dry]

Six minutes. DEODR is among the development packages; where it can't be imported, it is left out.
"""

import argparse
import os

# Before numpy and torch are imported: one thread everywhere but where threads are the point.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.fit_speed.chain_speed import TASKS, Rate, measure, write_clip
from benchmarks.fit_speed.fit_times import (
    Setup,
    cold,
    first_calls,
    fit_parts,
    fits_per_second,
    iteration_parts,
    losses,
    parts_ms,
    warm,
)
from benchmarks.fit_speed.tables import Results, markdown, plot, write
from benchmarks.fit_speed.targets import draw_known, draw_pair, species_template
from benchmarks.fit_speed.time_to_iou import SolverComparison, has_deodr

SIZES = (128, 256)
MOST_BEND_RAD = np.radians(120)
DOCS = Path(__file__).parents[2] / "docs"


def measure_all(num_targets: int) -> Results:
    """Every measurement, one after the other."""
    began, load = time.perf_counter(), os.getloadavg()[0]

    def say(what: str) -> None:
        print(f"{time.perf_counter() - began:4.0f} s  {what}", flush=True)

    setup = Setup(species_template())
    pairs = {size: [draw_pair(size=size, seed=s) for s in range(num_targets)] for size in SIZES}
    say("start-up")
    starting = first_calls()
    say("warm fits")
    warm_fits = {size: [warm(setup, pair) for pair in pairs[size]] for size in SIZES}
    threads = {n: fits_per_second(setup, pairs[128], threads=n, seconds=3) for n in (1, 2)}
    say("cold fits")
    known = (
        draw_known(setup.body, size=128, seed=s, most_bend_rad=MOST_BEND_RAD)
        for s in range(4 * num_targets + 4)
    )
    cold_fits = [cold(setup, one) for one in known]
    say("parts")
    first = {size: pairs[size][0] for size in SIZES}
    of_fit = {size: parts_ms(fit_parts(setup, pair)) for size, pair in first.items()}
    of_iteration = {size: parts_ms(iteration_parts(setup, pair)) for size, pair in first.items()}
    say("comparison to IoU 0.97")
    comparison = SolverComparison(setup.template)
    times = [
        one
        for size in SIZES
        for index, pair in enumerate(pairs[size])
        for one in comparison.run(pair, size=size, index=index)
    ]
    say("final L_rec")
    ends = [losses(setup, pair) for pair in pairs[128]]
    say("whole chain")
    chain = whole_chain()
    say("done")
    return Results(
        load=(load, os.getloadavg()[0]),
        times=times,
        warm=warm_fits,
        cold=cold_fits,
        fits_per_second=threads,
        losses=ends,
        first_calls=starting,
        chain=chain,
        fit_parts=of_fit,
        iteration_parts=of_iteration,
        remarks=[remark for remark in [has_deodr()] if remark],
    )


def whole_chain() -> dict[str, Rate]:
    """Each task once, after a run that loads what is compiled."""
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder)
        write_clip(clip, num_frames=120)
        measure(clip, next(iter(TASKS.values())))
        return {name: measure(clip, task) for name, task in TASKS.items()}


def main() -> None:
    """Measure, print, and write the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--targets", type=int, default=24, help="of each crop size")
    parser.add_argument("--dry", action="store_true", help="print only")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    results = measure_all(arguments.targets)
    text = markdown(results)
    print(text)
    if not arguments.dry:
        write(DOCS / "research" / "fit-speed.md", text)
        plot(results.times, DOCS / "images" / "performance.png")


if __name__ == "__main__":
    main()
