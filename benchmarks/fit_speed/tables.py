"""The measurements as Markdown tables and a plot."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.fit_speed.chain_speed import TASKS, Rate
from benchmarks.fit_speed.fit_times import ColdFit, Losses, WarmFit
from benchmarks.fit_speed.time_to_iou import SolverTime
from benchmarks.fit_speed.timing import Duration, spread

BEGIN, END = "<!-- begin of what `make bench` writes -->", "<!-- end of it -->"
SOLVERS = ("contour", "adam", "DEODR + Adam")
STARTS = ("warm", "cold", "cold, start known")


class Results(NamedTuple):
    """Everything that one run measured."""

    load: tuple[float, float]  # processes that wanted a core: at the start, at the end
    times: list[SolverTime]
    warm: dict[int, list[WarmFit]]  # by crop size
    cold: list[ColdFit]
    fits_per_second: dict[int, float]  # by threads
    losses: list[Losses]
    first_calls: tuple[list[float], list[float]]
    chain: dict[str, Rate]
    fit_parts: dict[int, dict[str, float]]  # CPU ms, by crop size
    iteration_parts: dict[int, dict[str, float]]
    remarks: list[str]


def markdown(results: Results) -> str:
    """All tables."""
    sections = [
        _machine(results),
        "### Against what we set out to reach\n\n" + _goals(results),
        "### Time to IoU 0.97\n\n" + _race(results.times),
        "### Warm fit\n\n" + _warm(results),
        "### Cold fit of bodies that the template can match exactly\n\n" + _cold(results.cold),
        "### Final L_rec against adam\n\n" + _losses(results.losses),
        "### First calls\n\n" + _first_calls(*results.first_calls),
        "### The whole chain, three fish in view, 1280 x 960 but for the last row\n\n"
        + _chain(results.chain),
        "### Where a warm fit spends its time, CPU ms\n\n" + _parts(results.fit_parts),
        "### Where an iteration spends its time, CPU ms\n\n" + _parts(results.iteration_parts),
    ]
    return "\n\n".join(sections)


def write(path: Path, text: str) -> None:
    """Put the tables in their place in a document."""
    before, rest = path.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    path.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")


def plot(times: list[SolverTime], path: Path) -> None:
    """Every one a dot, the medians bars, on a log scale."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    sizes = sorted({one.size for one in times})
    figure, axes = plt.subplots(1, len(sizes), figsize=(9, 3.6), sharey=True, squeeze=False)
    for axis, size in zip(axes[0], sizes, strict=True):
        for s, solver in enumerate(SOLVERS):
            for x, start in enumerate(STARTS):
                cpu_ms = _cpu_ms(_times_of(times, solver, start, size))
                place = x + 0.26 * (s - 1)
                axis.plot([place] * len(cpu_ms), cpu_ms, ".", color=f"C{s}", alpha=0.35, ms=4)
                if cpu_ms:
                    label = solver if x == 0 else None
                    axis.plot(
                        place, np.median(cpu_ms), "_", color=f"C{s}", ms=16, mew=3, label=label
                    )
        axis.set(yscale="log", title=f"{size} px", xticks=range(len(STARTS)), xticklabels=STARTS)
        axis.grid(axis="y", alpha=0.3)
    axes[0][0].set_ylabel("CPU ms to IoU 0.97")
    axes[0][0].legend(frameon=False)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def ratios(times: list[SolverTime], solver: str, start: str, size: int) -> list[float]:
    """CPU time of a solver over that of the contour solver, on the targets where both got there."""
    ours = {
        one.target: one.duration for one in _times_of(times, "contour", start, size) if one.duration
    }
    theirs = [one for one in _times_of(times, solver, start, size) if one.duration]
    both = [(one.duration, ours[one.target]) for one in theirs if one.target in ours]
    return [a.cpu_s / b.cpu_s for a, b in both if a is not None]


def _machine(results: Results) -> str:
    names = ("numba", "numpy", "torch", "opencv-python-headless", "deodr")
    packages = ", ".join(f"{name} {_version(name)}" for name in names)
    lines = [
        f"{os.cpu_count()} cores ({_processor()}), Python {platform.python_version()}, {packages}.",
        f"Processes that wanted a core: {results.load[0]:.1f} on average in the minute before the "
        f"start, {results.load[1]:.1f} in the last one.",
        *results.remarks,
    ]
    return "\n".join(lines)


def _goals(results: Results) -> str:
    rows = []
    for start, least in (("cold", 50), ("warm", 30)):
        for solver in SOLVERS[1:]:
            for size in sorted(results.warm):
                values = ratios(results.times, solver, start, size)
                if values:
                    what = f"time to IoU 0.97, {start}, {size} px: {solver} over contour"
                    middle = float(np.median(values))
                    rows.append((what, f"{least} x", f"{middle:.0f} x", middle >= least))
    for size, limit in ((128, 1.5), (256, 3.0)):
        wall, cpu = _medians([one.whole for one in results.warm[size]])
        rows.append(_time_row(f"warm fit, {size} px", limit, wall, cpu))
    wall, cpu = _medians([one.whole for one in results.cold])
    rows.append(_time_row("cold fit, 100 targets, 128 px", 20.0, wall, cpu))
    poor = sum(one.iou < 0.97 for one in results.cold)
    flips = sum(one.is_flipped for one in results.cold)
    rows.append(("cold fits below IoU 0.97", "0", str(poor), poor == 0))
    rows.append(("cold fits with head and tail swapped", "0", str(flips), flips == 0))
    most = results.fits_per_second[2]
    _, cpu = _medians([one.whole for one in results.warm[128]])
    shown = f"{most:.0f} ({2e3 / cpu:.0f} if two cores were free and shared nothing)"
    rows.append(("warm fits per second, 2 threads, 128 px", "1000", shown, most >= 1000))
    gaps = {
        "priors off": [one.contour_without_priors - one.adam for one in results.losses],
        "as shipped": [one.contour - one.adam for one in results.losses],
    }
    for which, values in gaps.items():
        gap = spread(values).median
        name = f"final L_rec, contour less adam, median, {which}"
        rows.append((name, "at most 0", f"{gap:+.4f}", gap <= 0))
    for name, task in TASKS.items():
        if task.to_reach is None:
            continue
        rate = results.chain[name]
        fps, best = rate.frames_per_second, 1e3 * (os.cpu_count() or 1) / rate.cpu_ms
        shown = f"{fps:.0f} frames/s ({best:.0f} if both cores were free and always busy)"
        rows.append((f"chain, {name}", f"{task.to_reach} frames/s", shown, fps >= task.to_reach))
    body = [f"| {a} | {b} | {c} | {'yes' if met else 'no'} |" for a, b, c, met in rows]
    return "\n".join(["| | to reach | measured | met |", "|---|---|---|---|", *body])


def _time_row(what: str, limit: float, wall: float, cpu: float) -> tuple[str, str, str, bool]:
    return what, f"{limit:g} ms", f"{wall:.1f} ms ({cpu:.1f} ms CPU)", wall <= limit


def _race(times: list[SolverTime]) -> str:
    rows = [
        "| start | crop | solver | got there | CPU ms: median (quartiles) | wall ms: median "
        "| CPU over contour's: median (quartiles) |",
        "|---|---|---|---|---|---|---|",
    ]
    for start in STARTS:
        for size in sorted({one.size for one in times}):
            for solver in SOLVERS:
                some = _times_of(times, solver, start, size)
                if not some:
                    continue
                there = [one.duration for one in some if one.duration]
                row = f"| {start} | {size} px | {solver} | {len(there)}/{len(some)} "
                if there:
                    wall, _ = _medians(there)
                    row += f"| {_range(_cpu_ms(some), '.1f')} | {wall:.1f} "
                    row += f"| {_range(ratios(times, solver, start, size), '.0f')} |"
                rows.append(row)
    return "\n".join(rows)


def _warm(results: Results) -> str:
    rows = [
        "| crop | `Fitter.fit`, wall ms | CPU ms | solver alone, wall ms | CPU ms | iterations "
        "| IoU, median |",
        "|---|---|---|---|---|---|---|",
    ]
    for size, fits in results.warm.items():
        cells = [f"{size} px"]
        for durations in ([one.whole for one in fits], [one.solver for one in fits]):
            cells.append(_range([one.wall_s * 1e3 for one in durations], ".2f"))
            cells.append(_range([one.cpu_s * 1e3 for one in durations], ".2f"))
        cells.append(_range([one.iterations for one in fits], ".0f"))
        cells.append(f"{np.median([one.iou for one in fits]):.3f}")
        rows.append(f"| {' | '.join(cells)} |")
    rates = ", ".join(f"{n} threads: {rate:.0f}" for n, rate in results.fits_per_second.items())
    return "\n".join(rows) + f"\n\nWarm fits per second at 128 px, {rates}."


def _cold(fits: list[ColdFit]) -> str:
    poor = sum(one.iou < 0.97 for one in fits)
    return (
        f"{len(fits)} random targets, bends to 120 degrees, 128 px: wall ms "
        f"{_range([one.whole.wall_s * 1e3 for one in fits], '.1f')}, CPU ms "
        f"{_range([one.whole.cpu_s * 1e3 for one in fits], '.1f')}; below IoU 0.97: {poor} (worst "
        f"{min(one.iou for one in fits):.3f}, median {np.median([one.iou for one in fits]):.4f}); "
        f"head and tail swapped: {sum(one.is_flipped for one in fits)}."
    )


def _losses(losses: list[Losses]) -> str:
    rows = [
        "| contour less adam | median (quartiles) | worst | no worse than 0.001 |",
        "|---|---|---|---|",
    ]
    for name, values in (
        ("as shipped, which minimises L_rec and its priors", [x.contour for x in losses]),
        ("without priors, the same objective", [x.contour_without_priors for x in losses]),
    ):
        gaps = [a - b.adam for a, b in zip(values, losses, strict=True)]
        close = sum(gap <= 1e-3 for gap in gaps)
        rows.append(f"| {name} | {_range(gaps, '+.4f')} | {max(gaps):+.4f} | {close}/{len(gaps)} |")
    return "\n".join(rows)


def _first_calls(empty: list[float], full: list[float]) -> str:
    rows = ["| s | imports | first cold and warm fit | the next ones |", "|---|---|---|---|"]
    for name, values in (("empty cache: compiles", empty), ("full cache: loads", full)):
        rows.append(f"| {name} | {' | '.join(f'{value:.2f}' for value in values)} |")
    return "\n".join(rows)


def _chain(rates: dict[str, Rate]) -> str:
    stages = list(next(iter(rates.values())).busy_ms)
    rows = [
        f"| | frames/s | CPU ms/frame | {' | '.join(f'{stage}, ms' for stage in stages)} |",
        "|---|---|---|" + "---|" * len(stages),
    ]
    for name, rate in rates.items():
        busy = " | ".join(f"{rate.busy_ms[stage]:.1f}" for stage in stages)
        rows.append(f"| {name} | {rate.frames_per_second:.1f} | {rate.cpu_ms:.1f} | {busy} |")
    return "\n".join(rows)


def _parts(parts: dict[int, dict[str, float]]) -> str:
    sizes = list(parts)
    rows = [f"| | {' | '.join(f'{size} px' for size in sizes)} |", "|---|" + "---|" * len(sizes)]
    for name in parts[sizes[0]]:
        rows.append(f"| {name} | {' | '.join(f'{parts[size][name]:.3f}' for size in sizes)} |")
    return "\n".join(rows)


def _times_of(times: list[SolverTime], solver: str, start: str, size: int) -> list[SolverTime]:
    return [one for one in times if (one.solver, one.start, one.size) == (solver, start, size)]


def _cpu_ms(times: list[SolverTime]) -> list[float]:
    return [one.duration.cpu_s * 1e3 for one in times if one.duration]


def _medians(times: list[Duration]) -> tuple[float, float]:
    """Wall and CPU ms."""
    wall, cpu = np.median(np.array(times), axis=0) * 1e3
    return float(wall), float(cpu)


def _range(values: list[float], form: str) -> str:
    middle = spread(values)
    return f"{middle.median:{form}} ({middle.low:{form}} to {middle.high:{form}})"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
