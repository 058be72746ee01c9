"""The contour solver by itself: warm and cold fits, their rate, final loss, parts, start-up."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.fit_speed.targets import FramePair, KnownTarget
from benchmarks.fit_speed.timing import Duration, median_duration, time_call
from stream_dmr.fitting.body import LOG_SIZE, MeshLevels
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.paper.adam import AdamSolver
from stream_dmr.fitting.solver import descent, mesh_terms, outline, spine
from stream_dmr.fitting.solver.contour_solver import ContourSolver
from stream_dmr.fitting.solver.descent import evaluate, normal_equations, weighted_squares
from stream_dmr.fitting.solver.outline import Residuals, project, visible_rim
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.solver.spine import KINDS, deform
from stream_dmr.fitting.starts import recentered
from stream_dmr.fitting.target import Target, mask_contour, signed_distance
from stream_dmr.fitting.uncertainty import covariance
from stream_dmr.template.template import Template

SPINE = KINDS["spine"]
ADAM_ITERATIONS = 300  # its steps have shrunk ten thousandfold by then


class WarmFit(NamedTuple):
    """One warm fit: the whole `Fitter.fit`, and its solver alone."""

    whole: Duration
    solver: Duration
    iterations: int
    iou: float


class ColdFit(NamedTuple):
    """One cold fit of a body that the template can match exactly."""

    whole: Duration
    iou: float
    is_flipped: bool
    bend_rad: float


class Losses(NamedTuple):
    """L_rec of eq. (3), priors left out, where each solver ended from one and the same start."""

    contour: float
    contour_without_priors: float
    adam: float


class Setup:
    """A template with all that the measurements need of it."""

    def __init__(self, template: Template) -> None:
        self.template = template
        self.settings = FitMeshSettings()
        self.bodies = MeshLevels.from_template(template, max_faces=self.settings.max_faces)
        self.body = self.bodies.fine

    def fitter(self, pair: FramePair) -> Fitter:
        """As the chain makes it, for the pair's reference plane."""
        return Fitter(self.template, self.settings, plane_normal=pair.plane_normal)

    def before(self, pair: FramePair) -> Float[np.ndarray, "P"]:
        """Parameters of the frame before, fitted from cold."""
        best = self.fitter(pair).fit(pair.before, None).best
        assert best is not None
        return best

    def start(self, pair: FramePair) -> tuple[Target, Float[np.ndarray, "P"]]:
        """What the solver of a warm fit is given."""
        target = Target.from_crop(pair.now, plane_normal=pair.plane_normal)
        return target, recentered(self.problem(target), self.before(pair))

    def problem(self, target: Target) -> Problem:
        """Of the fine mesh."""
        return Problem.from_settings(self.settings, self.body, target, with_smoothness=True)


def warm(setup: Setup, pair: FramePair) -> WarmFit:
    """A fit that starts from the frame before."""
    fitter, before = setup.fitter(pair), setup.before(pair)
    solver = ContourSolver(setup.bodies, setup.settings)
    target, start = setup.start(pair)
    found = solver.refine(target, start)
    return WarmFit(
        median_duration(lambda: fitter.fit(pair.now, before), repeats=7),
        median_duration(lambda: solver.refine(target, start), repeats=7),
        found.iterations,
        found.iou,
    )


def cold(setup: Setup, known: KnownTarget) -> ColdFit:
    """A fit that starts from nothing."""
    fitter, fitted = Fitter(setup.template, setup.settings), []
    duration = time_call(lambda: fitted.append(fitter.fit(known.crop, None).mesh))
    shape = fitted[0].shape
    v, K = setup.body.num_vertices, known.crop.crop_camera.K
    points = deform(setup.body, SPINE, known.parameters)[v : v + 3]
    truth = project(points, np.array([0.0, 0.0, 1.0]), K)
    head = shape.keypoints_px[0]
    is_flipped = np.linalg.norm(head - truth[2]) < np.linalg.norm(head - truth[0])
    return ColdFit(duration, shape.iou, bool(is_flipped), known.bend_rad)


def fits_per_second(setup: Setup, pairs: list[FramePair], *, threads: int, seconds: float) -> float:
    """Warm fits of all the pairs over and over, shared out to threads: numba releases the GIL."""
    jobs = [(setup.fitter(pair), pair.now, setup.before(pair)) for pair in pairs]
    until = time.perf_counter() + seconds

    def work(first: int) -> int:
        count = 0
        while time.perf_counter() < until:
            fitter, crop, before = jobs[(first + count) % len(jobs)]
            fitter.fit(crop, before)
            count += 1
        return count

    began = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        total = sum(pool.map(work, range(threads)))
    return total / (time.perf_counter() - began)


def losses(setup: Setup, pair: FramePair) -> Losses:
    """Where the solvers end; adam with so many iterations that its steps have died away."""
    target, start = setup.start(pair)
    bare = FitMeshSettings(prior_weight=0.0)
    patient = FitMeshSettings(solver="adam", adam_iterations=ADAM_ITERATIONS, tolerance=1e-12)
    ends = (
        ContourSolver(setup.bodies, setup.settings).refine(target, start),
        ContourSolver(setup.bodies, bare).refine(target, start),
        AdamSolver(setup.template, patient).refine(target, start),
    )
    problem = setup.problem(target)
    values = [evaluate(problem, end.parameters, True).terms @ problem.lambdas for end in ends]
    return Losses(*map(float, values))


def fit_parts(setup: Setup, pair: FramePair) -> dict[str, Callable[[], object]]:
    """What a warm `Fitter.fit` does, each part to be timed by itself."""
    settings, before = setup.settings, setup.before(pair)
    target, start = setup.start(pair)
    problem, solver = setup.problem(target), ContourSolver(setup.bodies, settings)
    parameters = solver.refine(target, start).parameters
    rendering = evaluate(problem, parameters, True).rendering
    mask, fitter = pair.now.mask, setup.fitter(pair)
    return {
        "signed distance map": lambda: signed_distance(mask),
        "contour of the mask": lambda: mask_contour(mask),
        "start moved onto the mask": lambda: recentered(problem, before),
        "solver": lambda: solver.refine(target, start),
        "terms of the result": lambda: evaluate(problem, parameters, True),
        "covariance": lambda: covariance(problem, settings, parameters, rendering),
        "all of `Fitter.fit`": lambda: fitter.fit(pair.now, before),
    }


def iteration_parts(setup: Setup, pair: FramePair) -> dict[str, Callable[[], object]]:
    """What one iteration of the solver does."""
    body, lm, out = setup.body, descent, outline
    target, start = setup.start(pair)
    problem, size = setup.problem(target), np.exp(start[LOG_SIZE])
    rendering = evaluate(problem, start, True).rendering
    points, pixels, rim, covered, normals, offsets = rendering
    edges = visible_rim(rendering).edges
    chosen, vertices = np.unique(edges), points[: body.num_vertices]
    rows = np.random.default_rng(0).normal(size=(len(edges) + len(target.contour), len(start)))
    residuals = Residuals(rows, np.ones(len(rows)), np.ones(len(rows)))
    H, g = normal_equations(problem, start, rendering)
    return {
        "evaluate": lambda: evaluate(problem, start, True),
        "- deform": lambda: deform(body, SPINE, start),
        "- project": lambda: project(vertices, target.anchor, target.K),
        "- rim": lambda: out.rim_edges(pixels, body),
        "- coverage": lambda: out.coverage(pixels, rim, len(target.mask)),
        "- overlap": lambda: out.overlap(covered, target),
        "- smoothness": lambda: mesh_terms.smoothness(body, normals, offsets, size),
        "normal equations": lambda: normal_equations(problem, start, rendering),
        "- visible rim": lambda: visible_rim(rendering),
        "- jacobian": lambda: spine.jacobian(body, SPINE, start, chosen),
        "- sums of squares": lambda: weighted_squares(residuals),
        "solve": lambda: lm.solve(H, g, 1e-2, np.zeros(len(g), np.bool_)),
    }


def parts_ms(parts: dict[str, Callable[[], object]], *, repeats: int = 60) -> dict[str, float]:
    """Median CPU milliseconds of each."""
    return {
        name: median_duration(call, repeats=repeats).cpu_s * 1e3 for name, call in parts.items()
    }


_FIRST_CALLS = """
import time
began = time.perf_counter()
from benchmarks.fit_speed.targets import species_template
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.pipeline.prepare_kernels import compile_kernels
from stream_dmr.fitting.body import LOG_SIZE
from stream_dmr.fitting.fit_settings import FitMeshSettings
fitter = Fitter(species_template(), FitMeshSettings())
ready = time.perf_counter()
compile_kernels(fitter)
first = time.perf_counter()
compile_kernels(fitter)
print(ready - began, first - ready, time.perf_counter() - first)
"""


def first_calls() -> tuple[list[float], list[float]]:
    """Seconds of importing, a process's first two fits and the next two: empty and full cache."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache}
        empty, full = (
            subprocess.run(
                [sys.executable, "-c", _FIRST_CALLS],
                cwd=Path(__file__).parents[2],
                env=environment,
                check=True,
                capture_output=True,
                text=True,
            ).stdout.split()
            for _ in range(2)
        )
    return [float(value) for value in empty], [float(value) for value in full]
