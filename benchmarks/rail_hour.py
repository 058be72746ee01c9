"""What a film of mostly water costs: CPU seconds of decoding it, of measuring it.

    python -m benchmarks.rail_hour [--minutes 2] [--template auto] [--every-picture]

A made minute of a rail in H.264, again and again: one, two, then three fish at once, in view for a
tenth of the time; a swaying camera, spray, light that changes. Beside it as much of it without a
fish. Of each: decoding alone, and a run of the command from the video alone, recordings on, by the
mesh of the species or by another template; the start (a run of a few frames) is taken off.
"""

import argparse
import csv
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import av
import cv2
import numpy as np

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.simulation.film import film
from stream_dmr.simulation.rail_scene import (
    FPS,
    RailScene,
    Visit,
    draw_calibration,
    draw_poses,
    find_preset,
)
from stream_dmr.simulation.simulated_fish import draw_fish
from stream_dmr.simulation.write_scene import write_species

_MINUTE = 60 * FPS  # frames
_VISIT = _MINUTE // 30  # frames of one fish
_STARTS = (0.2, 0.5, 0.5, 0.8, 0.8, 0.8)  # of the fish: one, two, three at once
_SWAY_PX, _SWAY_S = 3.0, 6.0
_LIGHT, _LIGHT_S = 0.12, 20.0  # of the brightness
_SPRAY_S = 10.0  # between bursts of spray, which last for 0.4 s
_START_FRAMES = 30
_FOLDER = Path("build/rail_hour")
# A process's peak memory begins with that of its parent, so the parent must be small.
_LAUNCHER = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[1:])
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
sys.exit(code)
"""
_DECODE = """
import sys, cv2
cv2.setNumThreads(1)
video = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG)
while video.read()[0]:
    pass
"""


class Cost(NamedTuple):
    """Of one command, with the processes that it started."""

    cpu_s: float
    peak_mb: float  # resident, of the largest process


def make_minute(path: Path, *, with_fish: bool, repeats: int, frames: int = _MINUTE) -> None:
    """Write the minute (or its first frames) so many times; its end fits its beginning."""
    stored = [_jpeg(image) for image in _pictures(with_fish, frames)]
    with av.open(str(path), "w") as video:
        stream = video.add_stream("libx264", FPS, options={"preset": "veryfast", "crf": "23"})
        stream.width, stream.height, stream.pix_fmt = 1280, 960, "yuv420p"
        for _ in range(repeats):
            for encoded in stored:
                picture = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8)
                video.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        video.mux(stream.encode(None))


def _jpeg(image: np.ndarray) -> np.ndarray:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 97])[1]


def _scene(*, with_fish: bool, frames: int) -> RailScene:
    preset, rng = find_preset("realistic"), np.random.default_rng(44)
    calibration = draw_calibration(rng)
    visits = [
        Visit(
            fish=draw_fish(rng, track_id=number),
            first_frame=1 + int(start * _MINUTE) + int(rng.integers(4)),
            poses=draw_poses(
                rng,
                preset,
                lane_mm=preset.lane_mm * (_STARTS[: number - 1].count(start) - 1),
                num_frames=_VISIT,
            ),
            is_gaffed=number == 4,
        )
        for number, start in enumerate(_STARTS, start=1)
    ]
    return RailScene(
        seed=44,
        preset=preset,
        calibration=calibration,
        num_frames=frames,
        visits=visits if with_fish else [],
    )


def _pictures(with_fish: bool, frames: int) -> Iterator[np.ndarray]:
    rng = np.random.default_rng(45)
    for shot in film(_scene(with_fish=with_fish, frames=frames)):
        seconds = shot.frame_index / FPS
        turn = 2 * np.pi * seconds
        x, y = _SWAY_PX * np.sin(turn / _SWAY_S), 0.5 * _SWAY_PX * np.sin(2 * turn / _SWAY_S)
        affine = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
        size = shot.image.shape[1::-1]
        image = cv2.warpAffine(shot.image, affine, size, borderMode=cv2.BORDER_REPLICATE)
        if seconds % _SPRAY_S < 0.4:
            for spot in rng.uniform(0, 1, (60, 3)):
                middle = (int(spot[0] * size[0]), int((0.6 + 0.4 * spot[1]) * size[1]))
                cv2.circle(image, middle, int(1 + 4 * spot[2]), (235, 235, 230), -1, cv2.LINE_AA)
        light = 1 + _LIGHT * np.sin(turn / _LIGHT_S)
        yield cv2.convertScaleAbs(image, alpha=light)


def cost_of(*command: str) -> Cost:
    """Run a command of Python."""
    launched = [sys.executable, "-c", _LAUNCHER, sys.executable, *command]
    done = subprocess.run(launched, check=True, text=True, capture_output=True)
    return Cost(*map(float, done.stdout.splitlines()[-1].split()))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=int, default=2)
    parser.add_argument("--template", default=str(_FOLDER / "species.ply"))
    parser.add_argument("--every-picture", action="store_true", help="look at all pictures")
    given = parser.parse_args(arguments)
    _FOLDER.mkdir(parents=True, exist_ok=True)
    write_species(_FOLDER / "species.ply")
    save_calibration(_FOLDER / "calibration.yaml", _scene(with_fish=True, frames=1).calibration)
    every_s = 0.0 if given.every_picture else 0.5
    (_FOLDER / "config.toml").write_text(f"[detect_fish]\nlook_every_s = {every_s}\n")
    options = ["run", "--overwrite", f"--template={given.template}"]
    options += [f"--calibration={_FOLDER}/calibration.yaml", f"--config={_FOLDER}/config.toml"]

    def run(video: Path) -> Cost:
        of_video = (f"--source={video}", f"--out={video.with_suffix('')}")
        return cost_of("-m", "stream_dmr.cli.main", *options, *of_video)

    start = _FOLDER / "start.mp4"
    if not start.exists():
        make_minute(start, with_fish=False, repeats=1, frames=_START_FRAMES)
    run(start)  # may compile
    start_s, num = run(start).cpu_s, given.minutes * _MINUTE
    print(f"{num} frames; the start {start_s:.1f} s of CPU\n")
    print("| | CPU s | ms a frame | times decoding | peak MB | fish | their mean mm |")
    print("|---|---|---|---|---|---|---|")
    for name, with_fish in (("water", False), ("rail", True)):
        video = _FOLDER / f"{name}-{given.minutes}.mp4"
        if not video.exists():
            make_minute(video, with_fish=with_fish, repeats=given.minutes)
        decoding_s = cost_of("-c", _DECODE, str(video)).cpu_s
        print(f"| decoding {name} | {decoding_s:.1f} | {1e3 * decoding_s / num:.1f} | 1 | | | |")
        cost = run(video)
        with (video.with_suffix("") / "lengths.csv").open() as file:
            lengths = [float(row["length_mm"]) for row in csv.DictReader(file) if row["length_mm"]]
        spent = cost.cpu_s - start_s
        shown = [f"{spent:.1f}", f"{1e3 * spent / num:.1f}", f"{spent / decoding_s:.1f}"]
        shown += [f"{cost.peak_mb:.0f}", f"{len(lengths)}"]
        shown += [f"{np.mean(lengths):.1f}" if lengths else ""]
        print(f"| measuring {name} | {' | '.join(shown)} |", flush=True)


if __name__ == "__main__":
    main()
