"""Does the scan of sizes lose anything? Its slow reference: all poses by Metropolis' algorithm.

    python -m benchmarks.accuracy.posterior [--scenes 2]      of every preset; two minutes a scene

`SizeScanner` weighs seven sizes by their best fit and the room around it. Here the same likelihood
and the same priors are sampled in all parameters instead (Metropolis et al., J. Chem. Phys. 21,
1953), for a few frames of every fish, and the lengths are combined as in a run.
"""

import os

# Before numpy and torch are imported: the processes are the threads.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numba import njit

from benchmarks.accuracy.oracles import final_estimate, map_scenes, scene_of, tracks_of
from benchmarks.fit_speed.targets import species_template
from benchmarks.table1.filmed_scene import film_passages
from stream_dmr.camera import Calibration
from stream_dmr.fitting.body import LOG_SIZE, MeshLevels
from stream_dmr.fitting.size import STD_SCALE
from stream_dmr.fitting.solver.descent import evaluate, normal_equations
from stream_dmr.fitting.solver.problem import Problem, prior_loss
from stream_dmr.fitting.tracks import TrackFitter
from stream_dmr.localization.localize_fish import localize
from stream_dmr.messages import FishCrop, FittedMesh, LocalizedFish
from stream_dmr.pipeline.config import Config
from stream_dmr.simulation.rail_scene import PRESETS

_FRAMES_PER_FISH = 5
_STEPS, _THIN, _BURN_IN = 24_000, 10, 0.2
_STIFFEST = 10.0  # directions that the curvature leaves free are not walked further than this
CONFIG = Config.model_validate({"smooth_length": {"min_frames": 1}})


@njit
def walk(problem, start, spread, nat, steps, thin, rng):  # type: ignore[no-untyped-def]
    """Parameters (steps / thin, P) as often as they are likely; `spread` (P, P) shapes steps."""
    size = len(start)
    here, kept = start.copy(), np.empty((steps // thin, size))
    loss = np.inf
    for step in range(steps):
        length = 2.0 / np.sqrt(size) * np.exp(rng.uniform(-1.5, 0.7))
        there = here + length * (spread @ rng.standard_normal(size)) * (step > 0)
        terms = evaluate(problem, there, False).terms
        other = np.sum(terms * problem.lambdas) + prior_loss(problem, there)
        if np.log(rng.random()) < (loss - other) / nat:
            here, loss = there, other
        if step % thin == thin - 1:
            kept[step // thin] = here
    return kept


class Sampler:
    """What `SizeScanner.expected` tells of the size, by sampling."""

    def __init__(self, tracks: TrackFitter, bodies: MeshLevels, config: Config) -> None:
        self._fitter, self._settings = tracks.fitter, config.fit_mesh
        self._body = bodies.coarse
        self._rng = np.random.default_rng(1)

    def log_size(self, crop: FishCrop, start: np.ndarray) -> tuple[float, float]:
        """Mean and std."""
        target, nat = self._fitter.target(crop).coarse(), self._settings.nat
        problem = Problem.from_settings(self._settings, self._body, target, with_smoothness=False)
        H, _ = normal_equations(problem, start, evaluate(problem, start, False).rendering)
        values, vectors = np.linalg.eigh((H + H.T) / (2 * nat))
        spread = vectors / np.sqrt(np.maximum(values, 1 / _STIFFEST))
        kept = walk(problem, start, spread, nat, _STEPS, _THIN, self._rng)
        sizes = kept[int(_BURN_IN * len(kept)) :, LOG_SIZE]
        return float(sizes.mean()), float(sizes.std())


def errors_of(task: tuple[str, int]) -> np.ndarray:
    """Relative errors of the fish of a scene, by the scan and by sampling (F, 2)."""
    filmed = film_passages(scene_of(task), with_second=False)
    template = species_template()
    tracks = TrackFitter(template, CONFIG.fit_mesh, calibration=filmed.calibration)
    sampler = Sampler(
        tracks, MeshLevels.from_template(template, max_faces=CONFIG.fit_mesh.max_faces), CONFIG
    )
    errors = []
    for track_id, track in tracks_of(filmed).items():
        fits = [(crop, tracks.fit(crop)) for crop in track]
        pairs = list(_lengths(fits, sampler, filmed.calibration))
        if pairs:
            lengths_mm = [_together(lengths) for lengths in zip(*pairs, strict=True)]
            errors.append(np.array(lengths_mm, float) / filmed.truth_mm[track_id] - 1)
    return np.array(errors).reshape(-1, 2)


def _lengths(
    fits: Sequence[tuple[FishCrop, FittedMesh]], sampler: Sampler, calibration: Calibration
) -> Iterator[tuple[LocalizedFish, LocalizedFish]]:
    """Some frames of a fish that count, by the scan and by sampling."""
    placed = [
        (crop, mesh.shape, fish)
        for crop, mesh in fits
        if (fish := localize(mesh, settings=CONFIG.localize, calibration=calibration)).accepted
    ]
    some = np.linspace(0, len(placed) - 1, min(len(placed), _FRAMES_PER_FISH)).round().astype(int)
    for crop, shape, fish in (placed[n] for n in some):
        assert shape is not None
        assert fish.length_mm is not None
        assert fish.length_std_mm is not None
        mean, std = sampler.log_size(crop, shape.parameters)
        length_mm = fish.length_mm * np.exp(mean - shape.parameters[LOG_SIZE])
        others = (fish.length_std_mm / fish.length_mm) ** 2 - shape.length_std_ratio**2
        variance = others + (STD_SCALE * std) ** 2
        yield fish, replace(fish, length_mm=length_mm, length_std_mm=length_mm * variance**0.5)


def _together(frames: Sequence[LocalizedFish]) -> float:
    """The fish's length; NaN where its frames contradict each other."""
    return final_estimate(frames, CONFIG).length_mm or float("nan")


def main() -> None:
    """Print the table."""
    scenes = map_scenes(errors_of, about=__doc__, scenes=2)
    print("| preset | fish | the scan: mean error, bias | all poses: mean error, bias |")
    print("|---|---|---|---|")
    for shown in (*PRESETS, "all"):
        errors = 100 * np.concatenate([one for preset, one in scenes if shown in (preset, "all")])
        errors = errors[np.isfinite(errors).all(axis=1)]
        means, biases = abs(errors).mean(axis=0), errors.mean(axis=0)
        cells = [f"{mean:.2f} %, {bias:+.2f} %" for mean, bias in zip(means, biases, strict=True)]
        print(f"| {shown} | {len(errors)} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
