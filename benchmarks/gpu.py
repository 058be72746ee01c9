"""Fits per second in batches on a GPU, and the roofline beside them.

    python benchmarks/gpu.py [--device cuda|cpu] [--batches 256 1024 4096 16384] [--size 128]

Without a GPU it says so and prints the arithmetic alone, for a data sheet's H200.
"""

import argparse
import os
import time
from collections.abc import Sequence
from itertools import cycle, islice

import numpy as np
import torch
from rates import Setup
from roofline import Load, Peak, load_of, peak_of, timed
from targets import Pair, draw_pair, species_template

from stream_dmr.fitting.batched import solver as solver_module
from stream_dmr.fitting.batched.distance_map import signed_distance
from stream_dmr.fitting.batched.solver import BatchedSolver
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.batched.warm_start import recentered
from stream_dmr.fitting.contour.solver import ContourSolver
from stream_dmr.fitting.settings import FitMeshSettings

NUM_TARGETS = 24  # those of benchmarks/solvers.py; batches repeat them
TO_REACH = 50_000


class Batch:
    """Warm fits of simulated fish, from the frame before."""

    def __init__(self, solver: BatchedSolver, pairs: Sequence[Pair], befores: list, count: int):
        self.solver = solver
        self.pairs = list(islice(cycle(pairs), count))
        self.starts = solver.tensor(np.array(list(islice(cycle(befores), count))))
        self.targets = self.prepared()

    def prepared(self) -> Targets:
        """Distance maps by the device, contours by the CPU."""
        crops, normal = [pair.now for pair in self.pairs], self.pairs[0].plane_normal
        return self.solver.prepare(crops, plane_normal=normal)

    def distances(self) -> None:
        """The device's share of that."""
        with torch.no_grad():
            signed_distance(self.targets.mask > 0.5, dtype=self.solver.dtype)

    def fit(self) -> None:
        """All of them, from the start moved onto the mask to the end."""
        with torch.no_grad():
            starts = recentered(self.solver.model, self.targets, self.starts)
            self.found = self.solver.refine_many(self.targets, starts)


def main() -> None:
    """Measure where there is a GPU, reckon in any case."""
    parser = argparse.ArgumentParser(description=__doc__)
    has_gpu = torch.cuda.is_available()
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda" if has_gpu else "cpu")
    parser.add_argument("--batches", type=int, nargs="+", default=[256, 1024, 4096, 16384])
    parser.add_argument("--size", type=int, default=128, help="of the crops, px")
    arguments = parser.parse_args()
    setup = Setup(species_template())
    pairs = [draw_pair(size=arguments.size, seed=seed) for seed in range(NUM_TARGETS)]
    # All before one plane, so that they make one batch.
    pairs = [pair._replace(plane_normal=pairs[0].plane_normal) for pair in pairs]
    befores = [setup.before(pair) for pair in pairs]
    settings = FitMeshSettings(device=arguments.device)
    solver = BatchedSolver(setup.bodies, settings)
    peak = peak_of(arguments.device)
    if arguments.device == "cpu":
        torch.set_num_threads(1)
        solver_module._BYTES_ON_CPU = 1 << 40  # all at once, as a GPU would have it
        print("No GPU here: nothing below is a measurement of one.\n")
        arguments.batches = arguments.batches[:1]
    print(f"{NUM_TARGETS} simulated fish at {arguments.size} px, warm, float32, {peak.name}:")
    print(f"{peak.bytes_per_s / 1e12:.1f} TB/s, {peak.flops_per_s / 1e12:.0f} TFLOP/s.\n")
    for count in arguments.batches:
        batch = Batch(solver, pairs, befores, count)
        loads = {"distance maps": load_of(batch.distances), "fits": load_of(batch.fit)}
        report(loads, peak, batch)
        if arguments.device == "cuda":
            measure(batch)
    agreement(setup, pairs, befores, batch)


def report(loads: dict[str, Load], peak: Peak, batch: Batch) -> None:
    """The least time by each resource, and the rate that the scarcest leaves."""
    count, found = len(batch.pairs), batch.found
    print(
        f"Batch of {count}: {found.iterations.double().mean():.1f} iterations in the mean, "
        f"{int(found.iterations.max())} at most; IoU {found.iou.median():.3f} in the median.\n"
    )
    print("| | MB/fit | MFLOP/fit | kernels | memory, us/fit | arithmetic | launches | bound |")
    print("|---|---|---|---|---|---|---|---|")
    total = Load(*map(sum, zip(*loads.values(), strict=True)))
    for name, load in {**loads, "together": total}.items():
        least = {what: seconds / count * 1e6 for what, seconds in load.seconds(peak).items()}
        cells = [f"{load.bytes / count / 1e6:.1f}", f"{load.flops / count / 1e6:.1f}"]
        cells += [str(load.kernels), *(f"{value:.2f}" for value in least.values())]
        print(f"| {name} | {' | '.join(cells)} | {1e6 / max(least.values()):,.0f} fits/s |")
    print()


def measure(batch: Batch) -> None:
    """Fits per second by the clock; contours are the CPU's part of the preparation."""
    count = len(batch.pairs)
    fits, distances = timed(batch.fit), timed(batch.distances)
    began = time.perf_counter()
    batch.prepared()
    torch.cuda.synchronize()
    prepared = time.perf_counter() - began
    print(
        f"Measured: {count / fits:,.0f} fits/s prepared, {count / (fits + distances):,.0f} with "
        f"distance maps ({TO_REACH:,} to reach), {count / (fits + prepared):,.0f} with contours "
        f"by {os.cpu_count()} cores as well.\n"
    )


def agreement(setup: Setup, pairs: Sequence[Pair], befores: list, batch: Batch) -> None:
    """How far from the compiled solver the batch ended."""
    compiled = ContourSolver(setup.bodies, setup.settings)
    gaps = []
    for index, pair in enumerate(pairs):
        target, start = setup.start(pair)
        gaps.append(batch.found.loss[index].item() - compiled.refine(target, start).loss)
    print(
        f"L_rec less that of the compiled solver, float64: median {np.median(gaps):+.1e}, "
        f"from {min(gaps):+.1e} to {max(gaps):+.1e}."
    )


if __name__ == "__main__":
    main()
