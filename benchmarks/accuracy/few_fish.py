"""How honest the intervals are where a stock was learnt from one to four fish.

    python -m benchmarks.accuracy.few_fish [--templates auto] [--scenes 1] [--first 9700]

Simulated catches of one species each, as hauled (`realistic`) and turned about the line by 60
degrees instead of 28 (`turning`): so many fish that a stock is learnt from, and two more that come
later, as at a camera, and may be of a body form too. Printed: mean error, bias, truths in the 95 %
interval, its width, and the mean squared error in stds (NEES); of the learnt breadths their error's
root mean square and NEES. `--templates all`: with every body form named, an hour of a core.
"""

import argparse
import os

# Before numpy is imported: the processes are the threads.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import multiprocessing
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.accuracy.judged_lengths import HEADER, JudgedLength, figures, judge
from benchmarks.fit_speed.targets import body_template
from benchmarks.table1.dmr import through_all
from benchmarks.table1.filmed_scene import FilmedScene, film_passages
from stream_dmr.fitting.shape.candidates import AUTO, CandidateShapes, load_shapes
from stream_dmr.fitting.shape.space import TRUNK, reshaped, std_of
from stream_dmr.fitting.shape.stocks import learn_shapes
from stream_dmr.messages import FishCrop, LearntShapes
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.simulation.rail_scene import PRESETS, make_scene
from stream_dmr.simulation.simulated_fish import SPECIES
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import bundled_names

FIRST_SEED = 9700
LEARNT_FROM = (1, 2, 3, 4)
WAYS = {"realistic": PRESETS["realistic"].yaw_deg, "turning": 60.0}
_LATER = 2  # fish that come after those that were learnt from
_FRAMES_PER_FISH = 20  # of the film: about twelve show each fish
_TRUNK_PLACES, _NEAR = np.array([0.2, 0.32, 0.45, 0.58, 0.7, 0.8]), 0.035  # body lengths


class MeasuredFish(NamedTuple):
    """One fish, and what it was measured by."""

    way: str
    species: str
    template: str
    learnt_from: int  # fish
    comes_later: bool  # than those
    length: JudgedLength


class LearntStock(NamedTuple):
    """One stock, and how far its breadth is from the species' mean."""

    way: str
    learnt_from: int
    breadth_error: float  # log
    breadth_std: float


class Task(NamedTuple):
    """One catch and the templates that it is measured by."""

    way: str
    species: str
    learnt_from: int
    seed: int
    templates: Sequence[str]


def measure_catch(task: Task) -> tuple[list[MeasuredFish], list[LearntStock]]:
    """The fish of one catch by each template, and the stocks that were learnt."""
    filmed = _filmed(task)
    crops = [sighting.crop for frame in filmed.frames for sighting in frame]
    first = [crop for crop in crops if crop.track_id <= task.learnt_from]
    later = [crop for crop in crops if crop.track_id > task.learnt_from]
    fish: list[MeasuredFish] = []
    stocks: list[LearntStock] = []
    for name in task.templates:
        template, forms = load_shapes(name)
        assert forms is not None
        learnt = learn_shapes(
            first, template, forms, Config().fit_mesh, calibration=filmed.calibration
        )
        if learnt is None:
            continue
        stocks += _stocks(task, template, learnt)
        fish += _measured(task._replace(templates=(name,)), filmed, first, template, learnt)
        known = forms.extended(_as_learnt(learnt, task.learnt_from))
        fish += _measured(task._replace(templates=(name,)), filmed, later, template, known)
    return fish, stocks


def _filmed(task: Task) -> FilmedScene:
    num_fish = task.learnt_from + _LATER
    scene = make_scene(
        num_fish=num_fish,
        num_frames=_FRAMES_PER_FISH * num_fish,
        preset="realistic",
        seed=task.seed,
        species=(SPECIES[task.species],),
    )
    factor = WAYS[task.way] / PRESETS["realistic"].yaw_deg
    visits = [
        replace(visit, poses=[replace(p, yaw_rad=_turned(p.yaw_rad, factor)) for p in visit.poses])
        for visit in scene.visits
    ]
    return film_passages(replace(scene, visits=visits), with_second=False)


def _turned(yaw_rad: float, factor: float) -> float:
    """So many times as far from showing the side with the eyes, or the blind side."""
    side = np.pi * round(yaw_rad / np.pi)
    return side + factor * (yaw_rad - side)


def _as_learnt(stocks: CandidateShapes, num_fish: int) -> LearntShapes:
    """What a camera's run says of them."""
    return LearntShapes(
        frame_index=0,
        timestamp_ns=0,
        names=stocks.names,
        coefficients=stocks.coefficients,
        covariances=stocks.covariances,
        shares=stocks.shares * num_fish / (num_fish + 1),
    )


def _measured(
    task: Task,
    filmed: FilmedScene,
    crops: Sequence[FishCrop],
    template: Template,
    candidates: CandidateShapes,
) -> Iterator[MeasuredFish]:
    nodes = Session(
        Setup(
            config=Config(),
            template=template,
            candidates=candidates,
            calibration=filmed.calibration,
        )
    ).nodes
    for length in judge(through_all(crops, nodes), filmed.truth_mm):
        yield MeasuredFish(
            way=task.way,
            species=task.species,
            template=task.templates[0],
            learnt_from=task.learnt_from,
            comes_later=length.track_id > task.learnt_from,
            length=length,
        )


def _stocks(task: Task, template: Template, learnt: CandidateShapes) -> Iterator[LearntStock]:
    own = _trunk_breadth(body_template(SPECIES[task.species]))
    for stock in learnt:
        yield LearntStock(
            way=task.way,
            learnt_from=task.learnt_from,
            breadth_error=_trunk_breadth(reshaped(template, stock.coefficients)) - own,
            breadth_std=std_of(TRUNK, stock.covariance),
        )


def _trunk_breadth(template: Template) -> float:
    """Mean log of half the breadth over the length between head and peduncle."""
    head, _, tail = template.keypoints
    place, across = ((template.rest_vertices - head) / (tail[0] - head[0])).T[:2]
    half = [np.abs(across[np.abs(place - at) < _NEAR]).max() for at in _TRUNK_PLACES]
    return float(np.log(half).mean())


def table(fish: Sequence[MeasuredFish], stocks: Sequence[LearntStock]) -> list[str]:
    """Lines of three tables: lengths, by template and species, and learnt breadths."""
    lines = [f"| | {HEADER} |", "|---" * 7 + "|"]
    for way in WAYS:
        for num in LEARNT_FROM:
            for comes_later in (False, True):
                group = [f for f in fish if f[0] == way and f[3:5] == (num, comes_later)]
                name = f"{way}, learnt from {num}" + (", fish that come later" * comes_later)
                lines += _line(name, group)
    for name in dict.fromkeys(one.template for one in fish):
        for species in SPECIES:
            lines += _line(f"{species} by `{name}`", [f for f in fish if f[1:3] == (species, name)])
    lines += ["", "| | stocks | error (rms) | std | NEES |", "|---" * 5 + "|"]
    for way in WAYS:
        for num in LEARNT_FROM:
            group = [stock for stock in stocks if stock[:2] == (way, num)]
            if group:
                errors, stds = np.array([stock[2:] for stock in group]).T
                rms, std = np.sqrt(np.mean(errors**2)), np.sqrt(np.mean(stds**2))
                nees = np.mean((errors / stds) ** 2)
                lines.append(
                    f"| {way}, {num} fish | {len(group)} | {rms:.3f} | {std:.3f} | {nees:.2f} |"
                )
    return lines


def _line(name: str, group: Sequence[MeasuredFish]) -> list[str]:
    return [f"| {name} | {figures([one.length for one in group])} |"] if group else []


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--templates", default=AUTO, help="names, or all")
    parser.add_argument("--ways", default=",".join(WAYS), help="how fish hang")
    parser.add_argument(
        "--learnt-from", default=",".join(map(str, LEARNT_FROM)), help="numbers of fish"
    )
    parser.add_argument("--scenes", type=int, default=1, help="of every species and number")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first scenes")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    names = arguments.templates.split(",")
    if names == ["all"]:
        names = [AUTO, *bundled_names()]
    tasks = [
        Task(way, species, num, 100 * (arguments.first + k) + 10 * number + num, names)
        for k in range(arguments.scenes)
        for way in arguments.ways.split(",")
        for number, species in enumerate(SPECIES)
        for num in map(int, arguments.learnt_from.split(","))
    ]
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        fish: list[MeasuredFish] = []
        stocks: list[LearntStock] = []
        for found in pool.imap(measure_catch, tasks):
            fish += found[0]
            stocks += found[1]
    print("\n".join(table(fish, stocks)))


if __name__ == "__main__":
    main()
