"""Every template on every species: mean error, bias, and truths in the 95 % interval.

    python -m benchmarks.accuracy.species [--scenes 1] [--templates auto,own,cod,gar.ply]

Simulated species whose bodies are not those of the bundled templates, 18 fish a scene, masks as the
simulator's film has them. `own`: the species' mean mesh; `auto`: shapes learnt from the scene; a
name: the same, but that body form is taken for likelier than the others; `gar.ply`: the mean mesh
of the simulated gar, given for any catch. All as a run takes them. Half an hour.
"""

import argparse
import os

# Before numpy is imported: the processes are the threads.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import multiprocessing
from collections.abc import Sequence

import numpy as np

from benchmarks.accuracy.judged_lengths import JudgedLength, judge
from benchmarks.accuracy.oracles import scene_of
from benchmarks.fit_speed.targets import body_template
from benchmarks.table1.dmr import through_all
from benchmarks.table1.filmed_scene import film_passages
from stream_dmr.fitting.shape.candidates import AUTO, load_shapes
from stream_dmr.messages import FishCrop
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.learn_shapes import learnt_from
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.simulation.simulated_fish import SPECIES, find_species
from stream_dmr.template.template_file import bundled_names

OWN = "own"
_MESH = ".ply"
CATCHES = (*SPECIES, "haddock,skipjack,halibut", "trout,perch,conger")
FIRST_SEED = 9000


def measure(task: tuple[str, int, Sequence[str]]) -> dict[str, list[JudgedLength]]:
    """One scene of a catch by each of the templates."""
    catch, seed, names = task
    species = find_species(catch)
    scene = scene_of(("realistic", seed), species=species)
    filmed = film_passages(scene, with_second=False)
    crops = [sighting.crop for frame in filmed.frames for sighting in frame]
    found: dict[str, list[JudgedLength]] = {}
    for name in names:
        if name == OWN and len(species) > 1:
            continue
        if name == OWN:
            template, shapes = body_template(species[0]), None
        elif name.endswith(_MESH):
            template, shapes = body_template(find_species(name.removesuffix(_MESH))[0]), None
        else:
            template, shapes = load_shapes(name)
        setup = Setup(
            config=Config(), template=template, candidates=shapes, calibration=filmed.calibration
        )
        setup = learnt_from(crops, setup, RunObserver())
        found[name] = _lengths(crops, filmed.truth_mm, setup)
    return found


def _lengths(
    crops: Sequence[FishCrop],
    truth_mm: dict[int, float],
    setup: Setup,
) -> list[JudgedLength]:
    nodes = Session(setup, first="fit").nodes
    return judge(through_all(crops, nodes), truth_mm)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=1, help="of every catch")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--templates", default=",".join((AUTO, OWN, *bundled_names())))
    arguments = parser.parse_args()
    names = arguments.templates.split(",")
    tasks = [(catch, FIRST_SEED + k, names) for catch in CATCHES for k in range(arguments.scenes)]
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        done = pool.imap(measure, tasks)
        print(f"| | {' | '.join(names)} |\n|{'---|' * (1 + len(names))}", flush=True)
        for catch in CATCHES:
            scenes = [next(done) for _ in range(arguments.scenes)]
            print(f"| {catch} | {' | '.join(_cell(scenes, name) for name in names)} |", flush=True)


def _cell(scenes: Sequence[dict[str, list[JudgedLength]]], name: str) -> str:
    measured = [length for scene in scenes for length in scene.get(name, [])]
    errors = 100 * np.array([length.error for length in measured])
    held = 100 * np.array([length.is_held for length in measured])
    if not len(errors):
        return ""
    return f"{abs(errors).mean():.1f}, {errors.mean():+.1f}, {held.mean():.0f}"


if __name__ == "__main__":
    main()
