"""What would help: the error of lengths if something were known that no mask shows.

    python -m benchmarks.accuracy.oracles [--scenes 4]      of every preset; three minutes

Scenes of our own, 18 fish each; masks as the simulator's film has them, ragged and cut by gaffs.
"""

import argparse
import os

# Before numpy and torch are imported: the processes are the threads.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from benchmarks.fit_speed.targets import body_template
from benchmarks.table1.dmr import through_all
from benchmarks.table1.filmed_scene import (
    FISH_PER_SCENE,
    FRAMES_PER_SCENE,
    FilmedScene,
    film_passages,
)
from stream_dmr.messages import FishCrop, LengthEstimate, LocalizedFish
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.simulation.rail_scene import PRESETS, RailScene, make_scene
from stream_dmr.simulation.simulated_fish import HALIBUT, SimulatedBody, pose_fish
from stream_dmr.template.template import Template

T = TypeVar("T")
FIRST_SEED = 5000
BODIES: dict[str, Callable[[SimulatedBody], SimulatedBody]] = {
    "nothing": lambda own: HALIBUT,
    "each fish's own body": lambda own: own,
    "only how broad it is": lambda own: replace(HALIBUT, half_width=own.half_width),
    "all of its body but how broad it is": lambda own: replace(own, half_width=HALIBUT.half_width),
}
SLANT = "how far the fish of its scene hang out of the plane (std of the prior)"


def errors_of(task: tuple[str, int]) -> dict[str, list[float]]:
    """Relative errors of the fish of one scene, by what was known."""
    scene = scene_of(task)
    filmed = film_passages(scene, with_second=False)
    bodies = {visit.fish.track_id: visit.fish.body for visit in scene.visits}
    found = {
        known: _errors(filmed, lambda i, of=of: body_template(of(bodies[i])), Config())
        for known, of in BODIES.items()
    }
    tilted = Config.model_validate({"fit_mesh": {"tilt_std_rad": slant_std_rad(scene)}})
    found[SLANT] = _errors(filmed, lambda i: body_template(HALIBUT), tilted)
    return found


def scene_of(
    task: tuple[str, int],
    *,
    num_frames: int = FRAMES_PER_SCENE,
    species: Sequence[SimulatedBody] = (HALIBUT,),
) -> RailScene:
    """The scene of a preset and a seed; several `species` take turns."""
    preset, seed = task
    return make_scene(
        num_fish=FISH_PER_SCENE, num_frames=num_frames, preset=preset, seed=seed, species=species
    )


def tracks_of(filmed: FilmedScene) -> dict[int, list[FishCrop]]:
    """The crops of each fish, in the order of their frames."""
    tracks: dict[int, list[FishCrop]] = {}
    for sighting in (sighting for frame in filmed.frames for sighting in frame):
        tracks.setdefault(sighting.crop.track_id, []).append(sighting.crop)
    return tracks


def final_estimate(frames: Sequence[LocalizedFish], config: Config) -> LengthEstimate:
    """What all these frames of one fish say together."""
    *_, final = through_all(frames, [SmoothLength(config.smooth_length)])
    assert isinstance(final, LengthEstimate)
    return final


def slant_std_rad(scene: RailScene) -> float:
    """Root mean square over the fish of their mean angle with the reference plane."""
    normal = scene.calibration.plane.rotation[:, 2]
    slants = []
    for visit in scene.visits:
        posed = (pose_fish(visit.fish, p, calibration=scene.calibration) for p in visit.poses)
        chords = [fish.keypoints[0] - fish.keypoints[2] for fish in posed]
        slants.append(np.mean([np.arcsin(c @ normal / np.linalg.norm(c)) for c in chords]))
    return float(np.sqrt(np.mean(np.square(slants))))


def _errors(
    filmed: FilmedScene, template_of: Callable[[int], Template], config: Config
) -> list[float]:
    errors = []
    for track_id, crops in tracks_of(filmed).items():
        nodes = Session(
            Setup(config=config, template=template_of(track_id), calibration=filmed.calibration)
        ).nodes
        final = [
            m for m in through_all(crops, nodes) if isinstance(m, LengthEstimate) and m.is_final
        ]
        lengths_mm = [estimate.length_mm for estimate in final if estimate.length_mm is not None]
        errors += [length_mm / filmed.truth_mm[track_id] - 1 for length_mm in lengths_mm]
    return errors


def map_scenes(
    work: Callable[[tuple[str, int]], T], *, about: str | None, scenes: int
) -> list[tuple[str, T]]:
    """What `work` makes of scenes of every preset, with the preset; by default `scenes`."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--scenes", type=int, default=scenes, help="of every preset")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    tasks = [(preset, FIRST_SEED + k) for k in range(arguments.scenes) for preset in PRESETS]
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        done = pool.map(work, tasks, chunksize=1)
    return [(preset, one) for (preset, _), one in zip(tasks, done, strict=True)]


def main() -> None:
    """Print the table."""
    scenes = [found for _, found in map_scenes(errors_of, about=__doc__, scenes=4)]
    print("| if one knew | fish | mean error | bias |\n|---|---|---|---|")
    for known in scenes[0]:
        errors = 100 * np.concatenate([scene[known] for scene in scenes])
        print(f"| {known} | {len(errors)} | {abs(errors).mean():.2f} % | {errors.mean():+.2f} % |")


if __name__ == "__main__":
    main()
