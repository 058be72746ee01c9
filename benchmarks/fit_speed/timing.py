"""Times of calls, and what a benchmark says about many of them."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Duration(NamedTuple):
    """Seconds of one call; `cpu_s` is free of waiting for a core on a shared machine."""

    wall_s: float
    cpu_s: float


class Spread(NamedTuple):
    """Median and quartiles of a sample."""

    median: float
    low: float
    high: float


def time_call(call: Callable[[], object]) -> Duration:
    """Run once, in this thread."""
    wall, cpu = time.perf_counter(), time.thread_time()
    call()
    return Duration(time.perf_counter() - wall, time.thread_time() - cpu)


def median_duration(call: Callable[[], object], *, repeats: int = 5) -> Duration:
    """The medians of some runs, after one that warms up."""
    call()
    walls, cpus = zip(*(time_call(call) for _ in range(repeats)), strict=True)
    return Duration(float(np.median(walls)), float(np.median(cpus)))


def spread(values: list[float]) -> Spread:
    """Median and quartiles."""
    low, median, high = np.percentile(values, [25, 50, 75]).tolist()
    return Spread(median, low, high)
