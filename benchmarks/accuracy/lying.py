"""Fish that lie on the reference plane, some of them turned or bent out of it: one picture each.

    python -m benchmarks.accuracy.lying [--fish 18] [--scenes 1] [--first 9600]

Simulated species, measured as by `run --pose lying --stills` with `--template auto`; one fish in
six is turned out of the plane by 15 to 35 degrees, one in six is bent out of it. `ruler` is the
distance from snout to tail fork along the plane, as marked by hand without error. Printed by
species: mean error and bias in percent, truths in the interval, and its width.
"""

import argparse
import os

# Before numpy is imported: the processes are the threads.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import multiprocessing
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.accuracy.judged_lengths import JudgedLength, judge
from benchmarks.table1.dmr import through_all
from benchmarks.table1.filmed_scene import FilmedScene, film_passages
from stream_dmr.camera import Calibration, ReferencePlane
from stream_dmr.fitting.shape.candidates import AUTO, load_shapes
from stream_dmr.fitting.shape.stocks import learn_shapes
from stream_dmr.pipeline.config import Config, lying, stills
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.simulation.rail_scene import PRESETS, RailScene, Visit, draw_calibration
from stream_dmr.simulation.simulated_fish import (
    SPECIES,
    HangingPose,
    SimulatedBody,
    SimulatedFish,
    draw_fish,
    pose_fish,
)

FIRST_SEED = 9600
FLAT, TURNED, BENT = "flat", "turned", "bent out of the plane"
_EVERY = 6  # one fish in so many is turned, and one is bent
_PICTURES_S = 10.0  # as `--stills` spaces them


class MeasuredFish(NamedTuple):
    """One fish and how it lies."""

    species: str
    lies: str
    ruler_error: float  # relative
    length: JudgedLength


def lying_scene(seed: int, species: SimulatedBody, *, num_fish: int) -> tuple[RailScene, list[str]]:
    """Fish on a plane 1.3 to 2.5 m before the camera, one in each frame, and how each lies."""
    rng = np.random.default_rng((seed, 9))
    drawn = draw_calibration(rng)
    translation_mm = drawn.plane.translation_mm * [0.3, 0.3, 0.0] + [0, 0, rng.uniform(1300, 2500)]
    plane = ReferencePlane(rotation=drawn.plane.rotation, translation_mm=translation_mm)
    calibration = Calibration(camera=drawn.camera, plane=plane)
    ways = [{0: TURNED, 1: BENT}.get(n % _EVERY, FLAT) for n in range(num_fish)]
    visits: list[Visit] = []
    for number, lies in enumerate(ways):
        fish = draw_fish(rng, track_id=number + 1, species=species)
        pose = _pose(rng, fish, lies)
        visits.append(Visit(fish=fish, first_frame=number + 1, poses=[pose], is_gaffed=False))
    scene = RailScene(
        seed=seed,
        preset=PRESETS["realistic"],
        calibration=calibration,
        num_frames=num_fish,
        visits=visits,
    )
    return scene, ways


def _pose(rng: np.random.Generator, fish: SimulatedFish, lies: str) -> HangingPose:
    """On its side, half a thickness above the plane: flat to a degree or two unless turned."""
    bends = np.zeros((3, 3))
    bends[2, :2] = rng.normal(0.0, (0.3, 0.15))
    bends[1, 0] = rng.choice([-1, 1]) * rng.uniform(0.5, 1.5) if lies == BENT else 0.0
    tilt = np.radians(rng.normal(0.0, 1.0))
    if lies == TURNED:
        tilt = np.radians(rng.choice([-1, 1]) * rng.uniform(15.0, 35.0))
    center = np.array([*rng.uniform(-60.0, 60.0, 2), -fish.body.half_thickness * fish.length_mm])
    return HangingPose(
        bends=bends,
        yaw_rad=np.pi * rng.integers(2) + np.radians(rng.normal(0.0, 2.0)),
        sway_rad=rng.uniform(-np.pi, np.pi),
        tilt_rad=tilt,
        center_world_mm=center,
    )


def measure(task: tuple[str, int, int]) -> list[MeasuredFish]:
    """The fish of one folder of pictures."""
    species, seed, num_fish = task
    scene, ways = lying_scene(seed, SPECIES[species], num_fish=num_fish)
    rulers = {visit.fish.track_id: _ruler_error(visit, scene) for visit in scene.visits}
    return [
        MeasuredFish(
            species=species,
            lies=ways[length.track_id - 1],
            ruler_error=rulers[length.track_id],
            length=length,
        )
        for length in _measured(film_passages(scene, with_second=False))
    ]


def _measured(filmed: FilmedScene) -> list[JudgedLength]:
    config = stills(lying(Config()), is_calibrated=True)
    crops = [
        replace(sighting.crop, timestamp_ns=round(number * _PICTURES_S * 1e9))
        for number, frame in enumerate(filmed.frames)
        for sighting in frame
    ]
    template, forms = load_shapes(AUTO, are_lying=True)
    assert forms is not None
    stocks = learn_shapes(crops, template, forms, config.fit_mesh, calibration=filmed.calibration)
    nodes = Session(
        Setup(config=config, template=template, candidates=stocks, calibration=filmed.calibration)
    ).nodes
    return judge(through_all(crops, nodes), filmed.truth_mm)


def _ruler_error(visit: Visit, scene: RailScene) -> float:
    posed = pose_fish(visit.fish, visit.poses[0], calibration=scene.calibration)
    chord, normal = posed.keypoints[0] - posed.keypoints[2], scene.calibration.plane.rotation[:, 2]
    along = chord - (chord @ normal) * normal
    return float(np.linalg.norm(along)) / visit.fish.length_mm - 1


def table(fish: Sequence[MeasuredFish]) -> list[str]:
    """A line for each species and how its fish lie, and one for all that lie so."""
    lines = [
        "| | fish | mean error | bias | held | width | ruler |",
        "|---|---|---|---|---|---|---|",
    ]
    for lies in (FLAT, TURNED, BENT):
        for name in (*SPECIES, "all"):
            group = [one for one in fish if one.lies == lies and name in (one.species, "all")]
            if group:
                lines.append(f"| {name}, {lies} | {len(group)} | {_figures(group)} |")
    return lines


def _figures(group: Sequence[MeasuredFish]) -> str:
    rulers = np.array([one.ruler_error for one in group])
    errors, stds = np.array([(one.length.error, one.length.std) for one in group]).T
    held = np.mean([one.length.is_held for one in group])
    return (
        f"{abs(errors).mean():.1%} | {errors.mean():+.1%} | {held:.0%} | {3.92 * stds.mean():.1%} "
        f"| {abs(rulers).mean():.1%}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fish", type=int, default=18, help="of every scene")
    parser.add_argument("--scenes", type=int, default=1, help="of every species")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first scene")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    tasks = [
        (species, arguments.first + k, arguments.fish)
        for species in SPECIES
        for k in range(arguments.scenes)
    ]
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        fish = [one for found in pool.imap(measure, tasks) for one in found]
    print("\n".join(table(fish)))


if __name__ == "__main__":
    main()
