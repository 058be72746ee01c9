"""The table and its pictures, into docs/research/table1.md and docs/images."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.table1.cached_results import Fish
from benchmarks.table1.dmr import PAPER_FRAMES
from stream_dmr.evaluation.compare import Evaluation, compare
from stream_dmr.evaluation.length_errors import EvaluateSettings

BEGIN, END = "<!-- begin of what `make table1` writes -->", "<!-- end of it -->"
TITLES = {
    "stereo": "Stereo (Huang et al. 2018)",
    "monopose": "MonoPose (Mei et al. 2021)",
    "bfs": "BFS",
    "monopose-flat": "MonoPose without bending",
    "bfs-flat": "BFS without bending",
    "dmr-flat": "DMR without bending",
    "paper-flat": "DMR as the paper wrote it, without bending",
    "paper": "DMR as the paper wrote it",
    "dmr": "**DMR (ours)**",
    "dmr-two": "**DMR by the two cameras of stereo (ours)**",
}
_PLOTTED = ("stereo", "monopose", "bfs", "dmr")
_HEADER = """\
| | bias, mm | EMD, mm | RMSD | KL | mean error | median | 90th percentile | bias | measured |
|---|---|---|---|---|---|---|---|---|---|"""


def evaluations(rows: dict[str, list[Fish]]) -> dict[str, Evaluation]:
    """Each row's figures, in the table's order."""
    return {
        row: compare(
            {fish.key: fish.measured for fish in rows[row]},
            {fish.key: fish.truth_mm for fish in rows[row]},
            settings=EvaluateSettings(),
        )
        for row in TITLES
        if row in rows
    }


def markdown(found: dict[str, Evaluation]) -> str:
    """The table, what its last row says of its own errors, and how many frames Adam had."""
    lines = [_HEADER, *(_line(TITLES[row], evaluation) for row, evaluation in found.items())]
    notes = []
    if "dmr" in found and (intervals := found["dmr"].intervals) is not None:
        nees = "" if intervals.nees is None else f", NEES {intervals.nees:.2f}"
        notes.append(
            f"Our 95 % intervals hold {100 * intervals.coverage:.1f} % of the true lengths; they "
            f"are {100 * intervals.mean_width:.1f} % of the length wide on average{nees}."
        )
    if "paper" in found:
        notes.append(
            f"As the paper wrote it: the mean of {PAPER_FRAMES} random frames of each fish, since "
            "Adam takes seconds a frame."
        )
    return "\n".join([*lines, *(f"\n{note}" for note in notes)])


def write(document: Path, text: str) -> None:
    """Put the table in its place in a document."""
    before, rest = document.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    document.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")


def worst_fish(rows: list[Fish], count: int) -> list[Fish]:
    """Those that were measured worst."""
    measured = [fish for fish in rows if fish.measured.length_mm is not None]
    return sorted(measured, key=lambda fish: -abs(_error(fish)))[:count]


def worst(rows: list[Fish], count: int = 5) -> list[str]:
    """The fish that were measured worst, for who wants to look at them: table1.worst."""
    return [
        f"scene {fish.scene}, fish {fish.track_id}: {fish.truth_mm:.0f} mm, {_error(fish):+.1%}"
        for fish in worst_fish(rows, count)
    ]


def _error(fish: Fish) -> float:
    return (fish.measured.length_mm or 0.0) / fish.truth_mm - 1


def plot(found: dict[str, Evaluation], folder: Path) -> None:
    """Both pictures: the histograms of all rows; errors by row and by length."""
    folder.mkdir(parents=True, exist_ok=True)
    _plot_histograms(found).savefig(folder / "table1_histograms.png", dpi=75)
    _plot_errors(found).savefig(folder / "table1_errors.png", dpi=75)


def _line(title: str, evaluation: Evaluation) -> str:
    e, d = evaluation.errors, evaluation.distributions
    cells = [title]
    if d is None:
        cells += ["-"] * 4
    else:
        shape = d.errors
        cells += [f"{shape.bias_mm:+.1f}", f"{shape.emd_mm:.1f}"]
        cells += [f"{100 * shape.rmsd:.1f} %", f"{shape.kl:.3f}"]
    if e is None:
        cells += ["-"] * 4
    else:
        cells += [
            f"{e.mean_absolute_mm:.1f} mm, {e.mean_absolute_percent:.2f} %",
            f"{e.median_absolute_percent:.2f} %",
            f"{e.p90_absolute_percent:.2f} %",
            f"{e.bias_percent:+.2f} %",
        ]
    cells.append(f"{100 * evaluation.fraction_measured:.1f} %")
    return f"| {' | '.join(cells)} |"


def _plot_histograms(found: dict[str, Evaluation]) -> Figure:
    shown = {row: e.distributions for row, e in found.items() if e.distributions is not None}
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    all_axes: Any = figure.subplots(3, 3, sharex=True, sharey=True)
    for axes, (row, pair) in zip(all_axes.flat, shown.items(), strict=False):
        truth, predicted = pair.truth, pair.predicted
        axes.stairs(100 * truth.shares, truth.edges_mm, fill=True, color="0.8", label="true")
        axes.stairs(100 * predicted.shares, predicted.edges_mm, color="C0", lw=2, label="measured")
        axes.set_title(f"{TITLES[row].strip('*')}: EMD {pair.errors.emd_mm:.1f} mm", fontsize=9)
    for axes in all_axes.flat[len(shown) :]:
        axes.set_axis_off()
    all_axes[0, 0].legend(frameon=False)
    figure.supxlabel("length, mm")
    figure.supylabel("fish, %")
    return figure


def _plot_errors(found: dict[str, Evaluation]) -> Figure:
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    bars, dots = figure.subplots(1, 2, width_ratios=(1, 1.3))
    measured = [row for row in found if found[row].errors is not None]
    for place, row in enumerate(reversed(measured)):
        errors = found[row].errors
        assert errors is not None
        bars.barh(place, errors.p90_absolute_percent, color="0.85")
        bars.barh(place, errors.mean_absolute_percent, color="C0" if row == "dmr" else "0.6")
    bars.set_yticks(range(len(measured)), [TITLES[row].strip("*") for row in reversed(measured)])
    bars.set_xlabel("error of a fish's length, %: mean, and 90th percentile (pale)")
    for number, row in enumerate(row for row in _PLOTTED if row in found):
        pairs = [(f.truth_mm, f.error_mm) for f in found[row].fish if f.error_mm is not None]
        truth_mm, error_mm = np.array(pairs).reshape(-1, 2).T
        percent = 100 * error_mm / truth_mm
        dots.plot(
            truth_mm, percent, ".", ms=2.5, color=f"C{3 - number}", label=TITLES[row].strip("*")
        )
    dots.axhline(0, color="k", lw=0.5)
    dots.set(xlabel="true length, mm", ylabel="error, %", ylim=(-30, 30))
    dots.legend(frameon=False, markerscale=4)
    return figure
