"""Time to a hard IoU of 0.97: the contour solver, our `adam`, and DEODR with Adam.

One thread. What is compared is the thread's CPU time: on a shared machine the wall clock doubles
long runs and spares short ones, which would flatter the fast solver. Each clock runs from the
crop's mask, so distance map and contour are included. The contour solver doesn't report while it
runs, so it is asked for ever more iterations until it gets there, and that run is timed; the others
are stopped by an exception as soon as an iterate is there.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from jaxtyping import Float

from benchmarks.fit_speed.targets import FramePair
from benchmarks.fit_speed.timing import Duration, median_duration, time_call
from stream_dmr.fitting.body import Body, MeshLevels
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.paper.adam import FAR, NEAR, AdamSolver, Objective, Terms
from stream_dmr.fitting.solver import contour_solver
from stream_dmr.fitting.solver.contour_solver import ContourSolver
from stream_dmr.fitting.solver.descent import Minimum, descend
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.starts import cold_starts, recentered
from stream_dmr.fitting.target import Target
from stream_dmr.template.template import Template

GOAL = 0.97
CAP = 300  # iterations of a gradient descent; then it counts as never there
DEODR_ITERATIONS = 100  # iterations from each cold start before the next one
_MOST_SIZE_OF_A_BATCH = 128  # 24 starts side by side take adam some 4 s at 256 px


class SolverTime(NamedTuple):
    """One solver at one target from one kind of start; no `duration`: it never got there."""

    solver: str
    start: str  # "warm", "cold", or "cold, start known"
    size: int
    target: int
    duration: Duration | None


class _Reached(Exception):
    pass


def has_deodr() -> str:
    """Empty where DEODR can be imported, else why not."""
    try:
        import deodr  # noqa: F401
    except ImportError as error:
        return f"DEODR could not be imported ({error}); pip install deodr"
    return ""


class SolverComparison:
    """All solvers on one template."""

    def __init__(self, template: Template) -> None:
        self._template = template
        self._levels = MeshLevels.from_template(template, max_faces=FitMeshSettings().max_faces)
        patient = FitMeshSettings(solver="adam", adam_iterations=CAP, tolerance=1e-12)
        self._adam = AdamSolver(template, patient)
        self._deodr = None
        if not has_deodr():
            from benchmarks.fit_speed.deodr_solver import DeodrSolver

            self._deodr = DeodrSolver(template)

    def run(self, pair: FramePair, *, size: int, index: int) -> Iterator[SolverTime]:
        """Every solver, side by side, on one target; nothing where warm is there already."""
        target = _target(pair)
        fitter = Fitter(self._template, FitMeshSettings(), plane_normal=pair.plane_normal)
        before = fitter.fit(pair.before, None).best
        assert before is not None
        known = self._known_start(target)
        runs = {"cold": self._cold(pair), "warm": self._warm(pair, before)}
        if size > _MOST_SIZE_OF_A_BATCH:
            del runs["cold"]["adam"]
        if known is not None:
            runs["cold, start known"] = self._from(pair, lambda _: known, near=False)
        for start, solvers in runs.items():
            for solver, measure in solvers.items():
                yield SolverTime(solver, start, size, index, measure())

    def _warm(
        self, pair: FramePair, before: Float[np.ndarray, "P"]
    ) -> dict[str, Callable[[], Duration | None]]:
        return self._from(pair, lambda t: recentered(self._problem(t), before), near=True)

    def _problem(self, target: Target) -> Problem:
        return Problem.from_settings(
            FitMeshSettings(), self._levels.fine, target, with_smoothness=True
        )

    def _from(
        self, pair: FramePair, start: Callable[[Target], Float[np.ndarray, "P"]], *, near: bool
    ) -> dict[str, Callable[[], Duration | None]]:
        """From one start."""
        step = NEAR if near else FAR

        def by_contour(settings: FitMeshSettings) -> None:
            target = _target(pair)
            with _stopping_contour(self._levels.fine):
                ContourSolver(self._levels, settings).refine(target, start(target))

        def by_adam() -> None:
            target = _target(pair)
            with _stopping_adam():
                self._adam.descend(target, start(target)[None], CAP, step)

        def by_deodr() -> None:
            target = _target(pair)
            self._deodr_from(target, start(target), CAP, step)

        return self._solvers(lambda: _shortest(by_contour), by_adam, by_deodr)

    def _cold(self, pair: FramePair) -> dict[str, Callable[[], Duration | None]]:
        """From nothing: each solver has the same cold starts to try."""

        def by_contour() -> None:
            target = _target(pair)
            starts = cold_starts(target, self._template)
            with _stopping_contour(self._levels.fine):
                ContourSolver(self._levels, FitMeshSettings()).search(target, starts)

        def by_adam() -> None:
            target = _target(pair)
            with _stopping_adam():
                self._adam.search(target, cold_starts(target, self._template))

        def by_deodr() -> None:
            target = _target(pair)
            for start in cold_starts(target, self._template):
                self._deodr_from(target, start, DEODR_ITERATIONS, FAR)

        return self._solvers(lambda: _until_reached(by_contour, repeats=3), by_adam, by_deodr)

    def _solvers(
        self,
        by_contour: Callable[[], Duration | None],
        by_adam: Callable[[], None],
        by_deodr: Callable[[], None],
    ) -> dict[str, Callable[[], Duration | None]]:
        solvers = {"contour": by_contour, "adam": lambda: _until_reached(by_adam)}
        if self._deodr is not None:
            solvers["DEODR + Adam"] = lambda: _until_reached(by_deodr)
        return solvers

    def _deodr_from(
        self, target: Target, start: Float[np.ndarray, "P"], iterations: int, step: float
    ) -> None:
        assert self._deodr is not None
        self._deodr.descend(target, start, iterations=iterations, step=step, watch=_stop_at_goal)

    def _known_start(self, target: Target) -> Float[np.ndarray, "P"] | None:
        """The first cold start that leads the contour solver to the goal."""
        solver = ContourSolver(self._levels, FitMeshSettings())
        for start in cold_starts(target, self._template):
            try:
                with _stopping_contour(self._levels.fine):
                    solver.refine(target, start)
            except _Reached:
                return start
        return None


def _target(pair: FramePair) -> Target:
    return Target.from_crop(pair.now, plane_normal=pair.plane_normal)


def _shortest(run: Callable[[FitMeshSettings], None]) -> Duration | None:
    """The time of the fewest iterations that get there."""
    for iterations in range(1, FitMeshSettings().contour_iterations + 1):
        settings = FitMeshSettings(contour_iterations=iterations)
        try:
            run(settings)
        except _Reached:
            return _until_reached(lambda s=settings: run(s), repeats=5)
    return None


def _until_reached(run: Callable[[], None], *, repeats: int = 1) -> Duration | None:
    has_reached = False

    def once() -> None:
        nonlocal has_reached
        try:
            run()
        except _Reached:
            has_reached = True

    duration = time_call(once) if repeats == 1 else median_duration(once, repeats=repeats)
    return duration if has_reached else None


def _stop_at_goal(iou: float) -> None:
    if iou >= GOAL:
        raise _Reached


@contextmanager
def _stopping_contour(body: Body) -> Iterator[None]:
    """Stops as soon as a minimisation of this body, not of a coarse one, ends at the goal."""

    def watched(problem: Problem, *rest: Any) -> Minimum:
        found = descend(problem, *rest)
        if problem.body is body:
            _stop_at_goal(found.iou)
        return found

    with patch.object(contour_solver, "descend", watched):
        yield


@contextmanager
def _stopping_adam() -> Iterator[None]:
    """Stops as soon as an iterate is at the goal."""
    original = Objective.terms

    def watched(objective: Objective, parameters: Any) -> Terms:
        terms = original(objective, parameters)
        _stop_at_goal(float(terms.iou.max()))
        return terms

    with patch.object(Objective, "terms", watched):
        yield
