"""Frames per second of the whole chain, three fish in view in every frame."""

import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from stream_dmr.calibration.calibration_file import load_calibration, save_calibration
from stream_dmr.pipeline.config import Config, to_toml
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_options import RunOptions
from stream_dmr.simulation.film import FilmedFrame, film
from stream_dmr.simulation.rail_scene import HEIGHT, WIDTH, make_scene
from stream_dmr.simulation.write_scene import encode_mask, write_species

NUM_FISH = 3
_CODEC = cv2.VideoWriter.fourcc(*"mp4v")
_MIN_VISIBLE_FRACTION = 0.9  # of each fish is in view, as in the middle of a passage


class Task(NamedTuple):
    """What one run is given, and what it records."""

    recording: dict[str, bool]
    has_masks: bool = True
    size: tuple[int, int] = (WIDTH, HEIGHT)
    to_reach: int | None = None  # frames/s


_BOTH, _MCAP, _NONE = {}, {"rrd": False}, {"mcap": False, "rrd": False}
TASKS = {
    "masks given, both recordings": Task(_BOTH, to_reach=60),
    "masks given, .mcap alone": Task(_MCAP),
    "masks given, no recording": Task(_NONE),
    "video alone, both recordings": Task(_BOTH, has_masks=False, to_reach=30),
    "video alone, no recording": Task(_NONE, has_masks=False),
    "video alone, 1920 x 1080, both recordings": Task(
        _BOTH, has_masks=False, size=(1920, 1080), to_reach=25
    ),
}


class Rate(NamedTuple):
    """How one run went."""

    frames_per_second: float
    num_frames: int
    cpu_ms: float  # of all threads, per frame: what other users of the machine don't change
    busy_ms: dict[str, float]  # of each stage, per frame


def write_clip(out: Path, *, num_frames: int, num_fish: int = NUM_FISH, seed: int = 1) -> None:
    """A simulated clip with so many fish in every frame, with exact masks and calibration."""
    num_slots = 4 * num_frames
    slots = make_scene(num_fish=num_fish, num_frames=num_slots, preset="realistic", seed=seed)
    together = [replace(visit, first_frame=1, is_gaffed=False) for visit in slots.visits]
    scene = replace(slots, visits=together)
    shots = (shot for shot in film(scene) if _shows_all(shot, num_fish))
    write_species(out / "species.ply")
    save_calibration(out / "calibration.yaml", scene.calibration)
    (out / "masks").mkdir()
    video = cv2.VideoWriter(str(out / "video.mp4"), _CODEC, 15, (WIDTH, HEIGHT))
    for index, shot in zip(range(1, num_frames + 1), shots, strict=False):
        video.write(shot.image)
        _write_mask(out / "masks" / f"{index:06d}.png", shot, num_fish)
    video.release()


def measure(clip: Path, task: Task) -> Rate:
    """Run the chain over a clip of `write_clip` once."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _resize(clip, folder, task.size)
        config = folder / "config.toml"
        config.write_text(to_toml(Config.model_validate({"recording": task.recording})))
        request = RunOptions(
            source=str(folder / "video.mp4"),
            calibration=folder / "calibration.yaml",
            masks=clip / "masks" if task.has_masks else None,
            template=str(clip / "species.ply"),
            config=config,
            out=folder / "out",
        )
        began = time.process_time()
        summary = measure_source(request, stop=threading.Event())
        cpu_s = time.process_time() - began
    count = summary.num_frames
    busy = {counter.stage: counter.busy_s * 1e3 / count for counter in summary.counters}
    return Rate(count / summary.elapsed_s, count, cpu_s * 1e3 / count, busy)


def _resize(clip: Path, folder: Path, size: tuple[int, int]) -> None:
    """The clip's video and calibration in another size."""
    calibration = load_calibration(clip / "calibration.yaml")
    camera = calibration.camera
    if size == (camera.width, camera.height):
        for name in ("video.mp4", "calibration.yaml"):
            (folder / name).symlink_to((clip / name).absolute())
        return
    scale = np.diag([size[0] / camera.width, size[1] / camera.height, 1.0])
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # from pixel centers to edges
    K = np.linalg.inv(half) @ scale @ half @ camera.K
    resized = replace(camera, width=size[0], height=size[1], K=K)
    save_calibration(folder / "calibration.yaml", replace(calibration, camera=resized))
    source = cv2.VideoCapture(str(clip / "video.mp4"))
    video = cv2.VideoWriter(str(folder / "video.mp4"), _CODEC, 15, size)
    while (read := source.read())[0]:
        video.write(cv2.resize(read[1], size))
    video.release()


def _shows_all(shot: FilmedFrame, num_fish: int) -> bool:
    visible = [box for box in shot.boxes if box.visible_fraction >= _MIN_VISIBLE_FRACTION]
    return len(visible) == num_fish


def _write_mask(path: Path, shot: FilmedFrame, num_fish: int) -> None:
    path.write_bytes(encode_mask(shot.labels, num_fish=num_fish))
