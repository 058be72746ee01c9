"""Frames per second of the whole chain, 1280 x 960, three fish in view in every frame."""

import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.running.config import Config, to_toml
from stream_dmr.running.measure_source import measure_source
from stream_dmr.running.run_request import RunRequest
from stream_dmr.simulation.film import FilmedFrame, film
from stream_dmr.simulation.rail_scene import HEIGHT, WIDTH, make_scene
from stream_dmr.simulation.write_scene import encode_mask, write_species

NUM_FISH = 3
_MIN_VISIBLE_FRACTION = 0.9  # of each fish is in view, as in the middle of a passage
RECORDINGS = {
    "both recordings (default)": {},
    ".mcap alone": {"rrd": False},
    "no recording": {"mcap": False, "rrd": False},
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
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    video = cv2.VideoWriter(str(out / "video.mp4"), codec, 15, (WIDTH, HEIGHT))
    for index, shot in zip(range(1, num_frames + 1), shots, strict=False):
        video.write(shot.image)
        _write_mask(out / "masks" / f"{index:06d}.png", shot, num_fish)
    video.release()


def measure(clip: Path, recording: dict[str, bool]) -> Rate:
    """Run the chain over a clip once."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "config.toml"
        config.write_text(to_toml(Config.model_validate({"recording": recording})))
        request = RunRequest(
            source=str(clip / "video.mp4"),
            calibration=clip / "calibration.yaml",
            masks=clip / "masks",
            template=str(clip / "species.ply"),
            config=config,
            out=Path(folder) / "out",
        )
        began = time.process_time()
        summary = measure_source(request, stop=threading.Event())
        cpu_s = time.process_time() - began
    count = summary.num_frames
    busy = {counter.stage: counter.busy_s * 1e3 / count for counter in summary.counters}
    return Rate(count / summary.elapsed_s, count, cpu_s * 1e3 / count, busy)


def _shows_all(shot: FilmedFrame, num_fish: int) -> bool:
    visible = [box for box in shot.boxes if box.visible_fraction >= _MIN_VISIBLE_FRACTION]
    return len(visible) == num_fish


def _write_mask(path: Path, shot: FilmedFrame, num_fish: int) -> None:
    path.write_bytes(encode_mask(shot.labels, num_fish=num_fish))
