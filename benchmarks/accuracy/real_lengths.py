"""Lengths by stills of real fish against those that people measured: a table and a plot.

    python -m benchmarks.accuracy.real_lengths PLOT.png NAME=RUN:TRUTH.csv ...

Each run is one of `run --stills`; its truth has a row for each picture with one fish: frame_index,
length_mm and group, such as a species on one day. The scale of such pictures is mostly a guess, and
what people measured ends with the tail's fin or before it: so one scale for each group is taken
out, its median. Beside them stands what one scale and a ruler's whole centimetres leave.
"""

import csv
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float


def measured(run: Path, truth: Path) -> dict[str, Float[np.ndarray, "N 4"]]:
    """Of each group's fish: the truth, the length and the ends of its interval, mm, scaled."""
    with (run / "frames.csv").open() as file:
        frame_of = {row["track_id"]: row["frame_index"] for row in csv.DictReader(file)}
    longest: dict[str, list[float]] = {}  # of each picture
    with (run / "lengths.csv").open() as file:
        for row in csv.DictReader(file):
            if row["length_mm"]:
                found = [float(row[k]) for k in ("length_mm", "ci95_low_mm", "ci95_high_mm")]
                frame = frame_of[row["track_id"]]
                longest[frame] = max(longest.get(frame, found), found)
    groups = defaultdict[str, list[list[float]]](list)
    with truth.open() as file:
        for row in csv.DictReader(file):
            if row["frame_index"] in longest:
                groups[row["group"]].append([float(row["length_mm"]), *longest[row["frame_index"]]])
    scaled = {name: np.array(rows) for name, rows in groups.items()}
    for rows in scaled.values():
        rows[:, 1:] /= np.median(rows[:, 1] / rows[:, 0])
    return scaled


def main(arguments: Sequence[str]) -> None:
    """Print the table, and draw the plot."""
    plot, *sets = arguments
    figure, panels = plt.subplots(1, len(sets), figsize=(4.2 * len(sets), 3.6), squeeze=False)
    print("| set | group | measured | mean error | rms | worst | held | width |")
    print("|---|---|---|---|---|---|---|---|")
    for panel, given in zip(panels[0], sets, strict=True):
        name, paths = given.split("=", 1)
        run, truth = map(Path, paths.rsplit(":", 1))
        for group, rows in measured(run, truth).items():
            true, length, low, high = rows.T
            errors = length / true - 1
            held = np.mean((low <= true) & (true <= high))
            print(
                f"| {name} | {group} | {len(rows)} | {np.abs(errors).mean():.1%} | "
                f"{np.sqrt(np.mean(errors**2)):.1%} | {errors[np.abs(errors).argmax()]:+.1%} | "
                f"{held:.0%} | {np.mean((high - low) / length):.1%} |"
            )
            bars = 100 * np.stack([length - low, high - length]) / true
            panel.errorbar(
                true / 10, 100 * errors, bars, fmt="o", ms=3, lw=0.7, alpha=0.7, label=group
            )
        panel.axhline(0, color="black", lw=0.8)
        panel.set(title=name, xlabel="measured by hand, cm", ylabel="error, %")
        panel.grid(alpha=0.3)
        panel.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(plot, dpi=90)


if __name__ == "__main__":
    main(sys.argv[1:])
