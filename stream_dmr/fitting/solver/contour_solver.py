"""The fast solver: a second-order search on the contour instead of gradient descent on pixels."""

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.body import ROOT_ROTATION, MeshLevels, joints_of
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.solver.descent import (
    COLD_DAMPING,
    EXHAUSTED,
    STOP_REASONS,
    WARM_DAMPING,
    Minimum,
    descend,
    evaluate,
)
from stream_dmr.fitting.solver.problem import Options, Problem, prior_loss
from stream_dmr.fitting.target import Solution, Target, rank

# Rounds of a search: their iterations, and how many starts enter them at the most.
_ROUNDS = ((2, 24), (4, 12))
_NUM_FINISHED = 2


class ContourSolver:
    """Levenberg-Marquardt on contour residuals, judged by the paper's L_rec."""

    def __init__(self, bodies: MeshLevels, settings: FitMeshSettings) -> None:
        self._body, self._coarse = bodies.fine, bodies.coarse
        self._settings = settings

    def refine(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        """From one start near the answer, and from its mirror image if that is more likely."""
        problem = Problem.from_settings(self._settings, self._body, target, with_smoothness=True)
        found = self._finish(problem, start)
        mirrored = mirror(found.parameters)
        gain = prior_loss(problem, found.parameters) - prior_loss(problem, mirrored)
        if gain < self._settings.tolerance:
            return found
        return min(found, self._finish(problem, mirrored), key=lambda solution: solution.loss)

    def search(self, target: Target, starts: Float[np.ndarray, "B P"]) -> Solution:
        """The likeliest start to its end; of the others the best after coarse rounds.

        The likeliest leads to the answer by itself most of the time, but not always.
        """
        coarse = Problem.from_settings(
            self._settings, self._coarse, target.coarse(), with_smoothness=False
        )
        likely = sorted(starts, key=lambda start: loss_of(coarse, start))
        found = [self.refine(target, likely.pop(0))]
        for iterations, most in _ROUNDS:
            rough = [self._rough(coarse, start, iterations) for start in likely[:most]]
            rough.sort(key=lambda solution: rank(target, solution))
            likely = [solution.parameters for solution in rough]
        found += [self.refine(target, start) for start in likely[:_NUM_FINISHED]]
        return min(found, key=lambda solution: rank(target, solution))

    def _finish(self, problem: Problem, start: Float[np.ndarray, "P"]) -> Solution:
        most = self._settings.contour_iterations
        return self._minimise(problem, start, iterations=most, damping=WARM_DAMPING)

    def _rough(self, problem: Problem, start: Float[np.ndarray, "P"], iterations: int) -> Solution:
        return self._minimise(problem, start, iterations=iterations, damping=COLD_DAMPING)

    def _minimise(
        self, problem: Problem, start: Float[np.ndarray, "P"], *, iterations: int, damping: float
    ) -> Solution:
        options = Options(iterations, self._settings.tolerance, damping)
        nothing = np.zeros(len(start), np.bool_)
        return solution_of(descend(problem, start, nothing, options))


def loss_of(problem: Problem, parameters: Float[np.ndarray, "P"]) -> float:
    """L_rec with the priors, without the mesh's smoothness: shapes differ in that at rest."""
    terms = evaluate(problem, parameters, False).terms
    return float(terms @ problem.lambdas) + prior_loss(problem, parameters)


def solution_of(found: Minimum) -> Solution:
    """The `Solution` of a descent."""
    settled = found.stop != EXHAUSTED
    reason = STOP_REASONS[found.stop]
    return Solution(found.parameters, found.loss, found.iou, found.iterations, settled, reason)


def mirror(parameters: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """The same body mirrored in depth, which from afar has the same silhouette.

    A body that is alike on both flat sides can't show which of its ends is nearer; only priors and
    perspective can. Rotation vectors (x, y, z) become (-x, -y, z), and parameters that couple the
    thickness to the rest change their sign.
    """
    mirrored = parameters.copy()
    mirrored[ROOT_ROTATION][:2] *= -1
    joints = joints_of(mirrored)
    joints.rotation[:, :2] *= -1
    joints.translation[:, 2] *= -1
    joints.weight[:, 4:] *= -1  # the entries (2, 0) and (2, 1)
    return mirrored
