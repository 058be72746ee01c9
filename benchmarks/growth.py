"""How speed and memory grow: fish in view, size of the picture, length of the run, workers.

    python -m benchmarks.growth [--frames 60] [--only fish size length workers] [--dry]

Runs from the video alone by the command itself, recordings on, one after the other: a quarter of an
hour. Writes docs/images/growth.png and the tables that docs/research/growth.md has between two
marks; without arguments all of it.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from benchmarks.fit_speed.chain_speed import write_clip

DOCS = Path(__file__).parents[1] / "docs"
BEGIN, END = "<!-- begin of what `python -m benchmarks.growth` writes -->", "<!-- end of it -->"
_SIZE = (1280, 960)
_RATE = re.compile(r"^(\d+).* frames in .* s, ([\d.]+) frames/s", re.MULTILINE)
# A process's peak memory begins with that of its parent, so the parent must be small.
_LAUNCHER = """
import resource, subprocess, sys, time
began = time.perf_counter()
code = subprocess.call(sys.argv[1:])
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, time.perf_counter() - began)
sys.exit(code)
"""
Pictures = Iterator[np.ndarray]


class Point(NamedTuple):
    """One run, or one batch."""

    x: float
    frames_per_s: float  # after the start, by the wall clock
    cpu_ms: float  # of all threads and the decoder, per frame, with the start
    peak_mb: float  # resident, of the largest process


class Plot(NamedTuple):
    """One question."""

    title: str
    unit: str
    points: list[Point]


def pictures(path: Path) -> Pictures:
    """The frames of a clip, again and again."""
    while True:
        capture = cv2.VideoCapture(str(path))
        while (read := capture.read())[0]:
            yield read[1]


def write_video(path: Path, frames: Pictures, *, num_frames: int) -> None:
    """The first of these frames as a video."""
    writer = None
    for _, frame in zip(range(num_frames), frames, strict=False):
        if writer is None:
            size = (frame.shape[1], frame.shape[0])
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 15, size)
        writer.write(frame)
    if writer is not None:
        writer.release()


def mosaic(tiles: Sequence[Pictures]) -> Pictures:
    """Four clips in one picture, each at half its size: more fish than a rail has room for."""
    half = (_SIZE[0] // 2, _SIZE[1] // 2)
    while True:
        a, b, c, d = (cv2.resize(next(tile), half, interpolation=cv2.INTER_AREA) for tile in tiles)
        yield np.vstack([np.hstack([a, b]), np.hstack([c, d])])


def run(video: Path, template: Path, out: Path) -> Point:
    """Measure one video by the command."""
    command = ["run", "--source", str(video), "--template", str(template), "--out", str(out)]
    output, cpu_s, peak_mb, _ = measured(command)
    found = _RATE.search(output)
    assert found, output
    frames, rate = int(found[1]), float(found[2])
    return Point(0, rate, 1e3 * cpu_s / frames, peak_mb)


def measured(command: Sequence[str]) -> tuple[str, float, float, float]:
    """Output, CPU seconds, peak memory and wall seconds of a command with its children."""
    done = subprocess.run(
        [sys.executable, "-c", _LAUNCHER, sys.executable, "-m", "stream_dmr.cli.main", *command],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    cpu_s, peak_mb, wall_s = (float(value) for value in done.stdout.splitlines()[-1].split())
    return done.stdout, cpu_s, peak_mb, wall_s


def three_fish(clip: Path, num_frames: int) -> Path:
    """Write a clip of three fish with their species into a new folder, which is returned."""
    clip.mkdir()
    write_clip(clip, num_frames=num_frames)
    return clip


def run_frames(frames: Pictures, clip: Path, name: str, *, num_frames: int) -> Point:
    """Measure the first of these frames, whose fish are those of `clip`."""
    video = clip.with_name(f"{name}.mp4")
    write_video(video, frames, num_frames=num_frames)
    return run(video, clip / "species.ply", clip.with_name(f"out-{name}"))


def by_fish(folder: Path, num_frames: int) -> Plot:
    """1 to 8 fish in a picture of 1280 x 960."""
    clips = {}
    for name, num_fish, seed in [("one", 1, 1), ("two", 2, 1), ("more", 2, 2)]:
        clips[name] = folder / name
        clips[name].mkdir()
        write_clip(clips[name], num_frames=num_frames, num_fish=num_fish, seed=seed)
    empty = next(pictures(clips["one"] / "video.mp4"))
    empty = np.ascontiguousarray(
        np.broadcast_to(np.median(empty, axis=1, keepdims=True), empty.shape)
    )
    rows = {1: ["one"], 2: ["two"], 4: ["two", "more"], 6: ["two", "more", "two"]}
    rows[8] = ["two", "more", "two", "more"]
    points = []
    for num_fish, names in rows.items():
        tiles = [pictures(clips[name] / "video.mp4") for name in names]
        tiles += [repeat(empty.astype(np.uint8))] * (4 - len(names))
        name = f"fish-{num_fish}"
        point = run_frames(mosaic(tiles), clips["one"], name, num_frames=num_frames)
        points.append(point._replace(x=num_fish))
    return Plot("fish in view, 1280 x 960", "fish", points)


def by_size(folder: Path, num_frames: int) -> Plot:
    """Three fish, from VGA to 4K."""
    clip = three_fish(folder / "three", num_frames)
    points = []
    for size in [(640, 480), (1280, 960), (1920, 1080), (3840, 2160)]:
        scaled = (cv2.resize(frame, size) for frame in pictures(clip / "video.mp4"))
        point = run_frames(scaled, clip, f"{size[0]}", num_frames=num_frames)
        points.append(point._replace(x=size[0] * size[1] / 1e6))
    return Plot("size of the picture, three fish", "megapixels", points)


def by_length(folder: Path, num_frames: int) -> Plot:
    """A looped clip of three fish."""
    clip = three_fish(folder / "loop", num_frames)
    points = []
    for times in (1, 4, 16, 48):
        count = times * num_frames
        point = run_frames(pictures(clip / "video.mp4"), clip, f"loop-{times}", num_frames=count)
        points.append(point._replace(x=count))
    return Plot("length of the run, three fish", "frames", points)


def by_workers(folder: Path, num_frames: int) -> Plot:
    """A batch of four videos by 1, 2 and 4 processes; frames/s with all starts."""
    clip = three_fish(folder / "batch", num_frames)
    rows = [f"{clip / 'video.mp4'},{clip / 'calibration.yaml'},,,v,t{n}," for n in range(4)]
    manifest = folder / "manifest.csv"
    manifest.write_text("\n".join(["video,calibration,boxes,masks,vessel,trip,haul", *rows]) + "\n")
    points = []
    for workers in (1, 2, 4):
        out = folder / f"out-batch-{workers}"
        command = ["batch", str(manifest), "--out", str(out), "--workers", str(workers)]
        command += ["--template", str(clip / "species.ply")]
        _, cpu_s, peak_mb, wall_s = measured(command)
        count = 4 * num_frames
        points.append(Point(workers, count / wall_s, 1e3 * cpu_s / count, peak_mb))
    return Plot("workers of a batch of four videos", "processes", points)


QUESTIONS: dict[str, Callable[[Path, int], Plot]] = {
    "fish": by_fish,
    "size": by_size,
    "length": by_length,
    "workers": by_workers,
}


def table(plot: Plot) -> str:
    """As Markdown."""
    lines = [f"| {plot.unit} | frames/s | CPU ms a frame | peak MB |", "|---|---|---|---|"]
    lines += [
        f"| {p.x:.3g} | {p.frames_per_s:.1f} | {p.cpu_ms:.0f} | {p.peak_mb:.0f} |"
        for p in plot.points
    ]
    return f"### {plot.title.capitalize()}\n\n" + "\n".join(lines)


def draw(plots: Sequence[Plot], path: Path) -> None:
    """One plot a question: frames/s, and the CPU time of a frame beside it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(plots), figsize=(3.6 * len(plots), 3.4), squeeze=False)
    for axis, plot in zip(axes[0], plots, strict=True):
        x = [point.x for point in plot.points]
        axis.plot(x, [point.frames_per_s for point in plot.points], "o-", label="frames/s")
        axis.plot(x, [point.cpu_ms for point in plot.points], "s--", label="CPU ms a frame")
        axis.plot(
            x, [point.peak_mb / 10 for point in plot.points], "^:", label="peak memory, 10 MB"
        )
        axis.set(
            title=plot.title, xlabel=plot.unit, xscale="log" if plot.unit == "frames" else "linear"
        )
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axes[0][0].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def main() -> None:
    """Measure, print, and write the page's tables and plots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=60, help="of a clip")
    parser.add_argument("--only", nargs="+", choices=QUESTIONS, default=list(QUESTIONS))
    parser.add_argument("--dry", action="store_true", help="print only")
    arguments = parser.parse_args()
    plots = []
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.only:
            plots.append(QUESTIONS[name](Path(folder), arguments.frames))
            print(table(plots[-1]), flush=True)
    if arguments.dry:
        return
    busy = f"{os.cpu_count()} cores, {load:.1f} processes wanting one at the start."
    page = DOCS / "research" / "growth.md"
    before, rest = page.read_text(encoding="utf-8").split(BEGIN)
    text = "\n\n".join([busy, *(table(plot) for plot in plots)])
    page.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{rest.split(END)[1]}", encoding="utf-8")
    draw(plots, DOCS / "images" / "growth.png")


if __name__ == "__main__":
    main()
