"""The table and the plot of docs/two-cameras.md: errors by the angle between the cameras.

    python -m benchmarks.accuracy.two_cameras runs/two-cameras [--plot docs/images/two-cameras.png]
        [--from-video]

Simulates 20 fish of two presets, and measures them by each camera and by both, with their masks and
mesh given or from the videos alone; half an hour. A camera's run that is in the folder already is
not repeated.
"""

import argparse
import csv
import threading
from collections import Counter, defaultdict
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import stream_dmr as sd
from stream_dmr.evaluation.compare import EvaluateSettings, compare
from stream_dmr.evaluation.length_tables import LengthRow, read_lengths, read_truth
from stream_dmr.pipeline.replay_recording import replay
from stream_dmr.pipeline.run_options import ReplayOptions
from stream_dmr.simulation import SECOND, simulate

SEEDS = {"realistic": 4511, "severe": 4512}  # other seeds than those the constants were chosen on
DEGREES = (35, 10, 20, 60, 90)  # the first camera is the same at all angles: it runs once
NUM_FISH, NUM_FRAMES = 20, 180
_NAMES = {"realistic": "realistic", "severe": "severe bends"}


def measured(scene: Path, camera: Path, *, from_video: bool) -> Path:
    """The folder of a camera's run."""
    run = camera / ("run-video" if from_video else "run")
    if not (run / "lengths.csv").exists():
        sd.measure(
            camera / "video.mp4",
            out=run,
            calibration=camera / "calibration.yaml",
            masks=None if from_video else camera / "masks",
            template="auto" if from_video else scene / "species.ply",
        )
    return run


def runs_of(preset: str, folder: Path, *, from_video: bool) -> dict[int, Path]:
    """The runs of a preset's fish: by one camera (0), and by two, so many degrees apart."""
    runs: dict[int, Path] = {}
    for degrees in DEGREES:
        scene = folder / preset / str(degrees)
        if not (scene / SECOND / "truth.csv").exists():
            simulate(
                scene,
                num_fish=NUM_FISH,
                num_frames=NUM_FRAMES,
                preset=preset,
                seed=SEEDS[preset],
                second_deg=degrees,
            )
        runs.setdefault(0, measured(scene, scene, from_video=from_video))
        runs[degrees] = scene / ("both-video" if from_video else "both")
        request = ReplayOptions(
            recordings=[runs[0]],
            first="localize",
            second=measured(scene, scene / SECOND, from_video=from_video),
            out=runs[degrees],
            overwrite=True,
        )
        replay(request, stop=threading.Event())
    return dict(sorted(runs.items()))


def of_true_fish(run: Path, scene: Path) -> dict[int, LengthRow]:
    """A run's lengths by the true fish that its tracks are nearest to; the longest track counts."""
    true: dict[str, list[tuple[int, list[float]]]] = defaultdict(list)
    with (scene / "truth_frames.csv").open() as file:
        for row in csv.DictReader(file):
            center_px = [float(row["center_u"]), float(row["center_v"])]
            true[row["frame_index"]].append((int(row["track_id"]), center_px))
    nearest: dict[int, Counter[int]] = defaultdict(Counter)
    with (run / "frames.csv").open() as file:
        for row in csv.DictReader(file):
            if row["center_u"] and (fish := true[row["frame_index"]]):
                center_px = np.array([float(row["center_u"]), float(row["center_v"])])
                far_px = [np.linalg.norm(center_px - place) for _, place in fish]
                nearest[int(row["track_id"])][fish[int(np.argmin(far_px))][0]] += 1
    lengths = read_lengths(run / "lengths.csv")
    found = sorted((seen.most_common(1)[0][::-1], track) for track, seen in nearest.items())
    measured = (fish for fish in found if lengths[fish[1]].length_mm is not None)
    return {fish: lengths[track] for (_, fish), track in measured}


def main() -> None:
    """Print the table, and draw the plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--from-video", action="store_true")
    args = parser.parse_args()
    print("| preset | degrees | fish | mean error | bias | truth in interval | its width |")
    print("|---|---|---|---|---|---|---|")
    _, axes = plt.subplots(figsize=(6.6, 3.1))
    for preset, marker in zip(SEEDS, "os", strict=True):
        scene = args.folder / preset / str(DEGREES[0])
        truth = read_truth(scene / "truth.csv")
        means: dict[int, float] = {}
        for degrees, run in runs_of(preset, args.folder, from_video=args.from_video).items():
            found = compare(of_true_fish(run, scene), truth, settings=EvaluateSettings())
            errors, intervals = found.errors, found.intervals
            assert errors is not None, run
            assert intervals is not None, run
            means[degrees] = errors.mean_absolute_percent
            num_measured = round(found.fraction_measured * len(found.fish))
            print(
                f"| {preset} | {degrees or 'one camera'} | {num_measured} | "
                f"{means[degrees]:.1f} % | {errors.bias_percent:+.1f} % | "
                f"{intervals.coverage:.0%} | {intervals.mean_width:.1%} |"
            )
        axes.plot([*means], [*means.values()], marker=marker, label=_NAMES[preset])
    ticks = sorted([0, *DEGREES])
    axes.set_xticks(ticks, [f"{n}°" if n else "one\ncamera" for n in ticks])
    axes.set(xlabel="between the cameras", ylabel="mean error, %", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend()
    if args.plot is not None:
        plt.tight_layout()
        plt.savefig(args.plot, dpi=100)


if __name__ == "__main__":
    main()
