"""How honest the intervals of the first fish of a camera's mixed catch are.

    python -m benchmarks.accuracy.live_catch [--scenes 4] [--first 9400]
    python -m benchmarks.accuracy.live_catch --folder SCENE

Simulated catches of three species each, in a random order, 18 fish a scene; or a scene's folder
with `video.mp4`, `calibration.yaml`, `boxes.txt`, `masks` and `truth.csv`. Shapes are learnt as at
a camera, from the fish that have left, for those that come into view then; here at once, so that
the table does not depend on the machine. Printed: mean error, bias, truths in the 95 % interval,
its width, and the mean squared error in stds (NEES), by how many fish the shapes were learnt from.
"""

import argparse
import os

# Before numpy is imported: the processes are the threads.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import multiprocessing
from collections.abc import Iterable, Iterator
from csv import DictReader
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.accuracy.judged_lengths import HEADER, JudgedLength, figures, judge
from benchmarks.accuracy.oracles import scene_of
from benchmarks.table1.filmed_scene import (
    FISH_PER_SCENE,
    FilmedScene,
    Sighting,
    film_passages,
)
from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.fitting.shape.candidates import AUTO, CandidateShapes, load_shapes
from stream_dmr.fitting.shape.stocks import GoodCrops, learn_shapes
from stream_dmr.messages import (
    FishCrop,
    FittedMesh,
    Frame,
    LearntShapes,
    LengthEstimate,
    TrackEnded,
)
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.simulation.rail_scene import FPS
from stream_dmr.simulation.simulated_fish import SPECIES
from stream_dmr.tracking.finder import open_finder
from stream_dmr.tracking.timeout import TrackTimeout

FIRST_SEED = 9400
SPECIES_PER_CATCH = 3
LEARNT_AT = (3, 6, 12)  # fish that have left; as `ShapeLearner` does
_NO_IMAGE = np.zeros((1, 1, 3), np.uint8)
_TIMEOUT_S = 0.25  # fish follow each other in fractions of a second here, hardly ever unseen


class MeasuredFish(NamedTuple):
    """One fish of a catch, and what it was measured by."""

    scene: int
    species: str
    shape: str  # the candidate's name
    learnt_from: int  # fish; 0 where it was measured by a body form
    known: int  # fish that had been learnt from when it came into view
    length: JudgedLength


def measure_catch(seed: int) -> list[MeasuredFish]:
    """All fish of one catch."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice(sorted(SPECIES), SPECIES_PER_CATCH, replace=False)
    order = rng.choice(kinds, FISH_PER_SCENE)
    scene = scene_of(("realistic", seed), species=[SPECIES[name] for name in order])
    filmed = film_passages(scene, with_second=False)
    return [
        fish._replace(scene=seed, species=str(order[int(fish.species) - 1]))
        for fish in _Camera(filmed).run()
    ]


def read_scene(folder: Path) -> FilmedScene:
    """A folder's fish, as the chain cuts them out, at the simulator's frame rate."""
    config, calibration = Config(), load_calibration(folder / "calibration.yaml")
    finder = open_finder(
        boxes=folder / "boxes.txt",
        masks=folder / "masks",
        detect=config.detect_fish,
        track=config.track_fish,
    )
    crop_fish = CropFish(config.crop_fish, camera=calibration.camera, finder=finder)
    reader = ReadFrames(str(folder / "video.mp4"), config.read_frames)
    frames = [
        [
            Sighting(replace(crop, image=None, timestamp_ns=_capture_ns(number)), None)
            for crop in crop_fish.step(frame)
            if isinstance(crop, FishCrop)
        ]
        for number, frame in enumerate(reader.source, start=1)
    ]
    reader.close()
    with (folder / "truth.csv").open(encoding="utf-8") as file:
        truth_mm = {int(row["track_id"]): float(row["length_mm"]) for row in DictReader(file)}
    return FilmedScene(calibration=calibration, truth_mm=truth_mm, frames=frames)


def _capture_ns(frame: int) -> int:
    return frame * 1_000_000_000 // FPS


class _Camera:
    """The chain of a live run over a filmed scene."""

    def __init__(self, filmed: FilmedScene) -> None:
        self._filmed, self._now_ns = filmed, 0
        self._timeout = TrackTimeout(_TIMEOUT_S)
        self._config = Config()
        self._template, self._forms = load_shapes(AUTO)
        assert self._forms is not None
        self._known: CandidateShapes = self._forms
        self._learnt_from = [0] * len(self._forms)
        nodes = Session(
            Setup(
                config=self._config,
                template=self._template,
                candidates=self._forms,
                calibration=filmed.calibration,
            )
        ).nodes
        self._fit, self._later = nodes[0], nodes[1:]
        assert isinstance(self._fit, FitMesh)
        self._crops: dict[int, GoodCrops] = {}
        self._finished: list[list[FishCrop]] = []
        self._chosen: dict[int, int] = {}
        self._seen_knowing: dict[int, int] = {}

    def run(self) -> Iterator[MeasuredFish]:
        """Every fish that is given a length; `species` is its track id."""
        for number, sightings in enumerate(self._filmed.frames, start=1):
            self._now_ns = _capture_ns(number)
            for sighting in sightings:
                self._take(sighting.crop)
            seen = [sighting.crop.track_id for sighting in sightings]
            yield from self._finish(self._pass_time(seen))
        yield from self._finish(
            [one for node in self._later for one in node.close() if isinstance(one, LengthEstimate)]
        )

    def _take(self, crop: FishCrop) -> None:
        self._crops.setdefault(crop.track_id, GoodCrops()).add(crop)
        self._seen_knowing.setdefault(crop.track_id, max(self._learnt_from))
        messages = self._fit.step(crop)
        for mesh in messages:
            if isinstance(mesh, FittedMesh) and mesh.shape is not None:
                self._chosen[mesh.track_id] = mesh.shape.candidate or 0
        for node in self._later:
            messages = [out for message in messages for out in node.step(message)]

    def _pass_time(self, seen: Iterable[int]) -> list[LengthEstimate]:
        smooth = self._later[-1]
        assert isinstance(smooth, SmoothLength)
        gone = self._timeout.step(self._now_ns, seen)
        last = Frame(frame_index=0, timestamp_ns=self._now_ns, image=_NO_IMAGE, source="")
        ends = [TrackEnded.after(last, track_id, "timeout") for track_id in gone]
        return [one for ended in ends for one in smooth.end(ended)]

    def _finish(self, estimates: list[LengthEstimate]) -> Iterator[MeasuredFish]:
        for one in estimates:
            if not one.is_final:
                continue
            chosen = self._crops.pop(one.track_id, GoodCrops()).chosen()
            if chosen:
                self._finished.append(chosen)
                if len(self._finished) in LEARNT_AT:
                    self._learn()
            for length in judge([one], self._filmed.truth_mm):
                shape = self._chosen[one.track_id]
                yield MeasuredFish(
                    scene=0,
                    species=str(one.track_id),
                    shape=self._known.names.split(",")[shape],
                    learnt_from=self._learnt_from[shape],
                    known=self._seen_knowing[one.track_id],
                    length=length,
                )

    def _learn(self) -> None:
        num_fish = len(self._finished)
        stocks = learn_shapes(
            [crop for crops in self._finished for crop in crops],
            self._template,
            self._forms,
            self._config.fit_mesh,
            calibration=self._filmed.calibration,
        )
        if stocks is None:
            return
        self._known = self._known.extended(
            LearntShapes(
                frame_index=0,
                timestamp_ns=self._now_ns
                + 1,  # for fish that come into view from the next frame on
                names=stocks.names,
                coefficients=stocks.coefficients,
                covariances=stocks.covariances,
                shares=stocks.shares * num_fish / (num_fish + 1),
            )
        )
        self._learnt_from += [num_fish] * len(stocks)
        self._fit.learn(self._known)


def table(fish: list[MeasuredFish]) -> list[str]:
    """One line for each number of fish that the shapes were learnt from, and one for all."""
    lines = [f"| learnt from | {HEADER} |", "|---" * 7 + "|"]
    groups = [
        (str(known), [one for one in fish if one.known == known]) for known in (0, *LEARNT_AT)
    ]
    own_form = [one for one in fish if one.learnt_from == 0 and one.known > 0]
    for name, group in [*groups, ("(by a body form all the same)", own_form), ("all", fish)]:
        if group:
            lines.append(f"| {name} | {figures([one.length for one in group])} |")
    return lines


def main() -> None:
    """Print every fish that its interval does not hold, and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first scene")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="a scene to take instead")
    arguments = parser.parse_args()
    if arguments.folder is not None:
        print("\n".join(table([*_Camera(read_scene(arguments.folder)).run()])))
        return
    seeds = range(arguments.first, arguments.first + arguments.scenes)
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        fish = []
        for catch in pool.imap(measure_catch, seeds):
            fish += catch
            for one in catch:
                if not one.length.is_held:
                    print(f"not held: {one}", flush=True)
    print("\n".join(table(fish)))


if __name__ == "__main__":
    main()
