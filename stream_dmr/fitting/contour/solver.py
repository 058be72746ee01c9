"""The fast solver: a second-order search on the contour instead of gradient descent on pixels."""

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.body import JOINT, ROOT, Body, rest_vector
from stream_dmr.fitting.contour.deformation import KINDS
from stream_dmr.fitting.contour.levenberg_marquardt import (
    EXHAUSTED,
    FAR,
    NEAR,
    STOP_REASONS,
    Minimum,
    evaluate,
    minimise,
)
from stream_dmr.fitting.contour.normal_equations import prior_loss
from stream_dmr.fitting.mesh_levels import Bodies
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.solver import Solution, rank
from stream_dmr.fitting.target import Target

# Of a search: iterations of a round, and how many starts go into it at the most.
_ROUNDS = ((2, 24), (4, 12))
_NUM_FINISHED = 2


class ContourSolver:
    """Levenberg-Marquardt on contour residuals, judged by the paper's L_rec."""

    def __init__(self, bodies: Bodies, settings: FitMeshSettings) -> None:
        self._body, self._coarse = bodies.fine, bodies.coarse
        self._settings = settings
        self._kind = KINDS[settings.deformation]
        self._rest = rest_vector(len(bodies.fine.joints))
        self._lambdas, self._priors = settings.lambdas(), settings.priors()
        self._rough_lambdas = settings.rough_lambdas()

    def refine(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        """From one start near the answer, and from its mirror image where that is more likely."""
        found = self._finish(target, start)
        mirrored = mirror(found.flat)
        gain = self._prior_loss(target, found.flat) - self._prior_loss(target, mirrored)
        if gain < self._settings.tolerance:
            return found
        return min(found, self._finish(target, mirrored), key=lambda solution: solution.loss)

    def _finish(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        most = self._settings.contour_iterations
        return self._minimise(
            self._body, target, start, self._lambdas, iterations=most, damping=NEAR
        )

    def _prior_loss(self, target: Target, flat: Float[np.ndarray, "P"]) -> float:
        return prior_loss(target, flat, self._rest, self._priors)

    def search(self, target: Target, starts: Float[np.ndarray, "B P"]) -> Solution:
        """The likeliest start to its end; of the others the best after coarse rounds.

        The likeliest leads to the answer by itself most of the time, but not always.
        """
        coarse = target.coarse()
        flats = sorted(starts, key=lambda flat: self._rough_loss(coarse, flat))
        found = [self.refine(target, flats.pop(0))]
        for iterations, most in _ROUNDS:
            rough = [self._rough(coarse, flat, iterations) for flat in flats[:most]]
            rough.sort(key=lambda solution: rank(target, solution))
            flats = [solution.flat for solution in rough]
        found += [self.refine(target, flat) for flat in flats[:_NUM_FINISHED]]
        return min(found, key=lambda solution: rank(target, solution))

    def _rough_loss(self, target: Target, flat: Float[np.ndarray, "P"]) -> float:
        terms, *_ = evaluate(self._coarse, self._kind, target, flat, False)
        return float(terms @ self._rough_lambdas) + self._prior_loss(target, flat)

    def _rough(self, target: Target, start: Float[np.ndarray, "P"], iterations: int) -> Solution:
        lambdas = self._rough_lambdas
        return self._minimise(
            self._coarse, target, start, lambdas, iterations=iterations, damping=FAR
        )

    def _minimise(
        self,
        body: Body,
        target: Target,
        start: Float[np.ndarray, "P"],
        lambdas: Float[np.ndarray, "6"],
        *,
        iterations: int,
        damping: float,
    ) -> Solution:
        found = minimise(
            body,
            self._kind,
            target,
            lambdas,
            self._priors,
            start,
            self._rest,
            np.zeros(len(start), np.bool_),  # nothing is held
            iterations,
            self._settings.tolerance,
            damping,
        )
        return solution_of(found)


def solution_of(found: Minimum) -> Solution:
    """What a descent found, as every solver says it."""
    settled = found.stop != EXHAUSTED
    reason = STOP_REASONS[found.stop]
    return Solution(found.flat, found.loss, found.iou, found.iterations, settled, reason)


def mirror(flat: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """The same body mirrored in depth, which from afar has the same silhouette.

    A body that is alike on both flat sides can't show which of its ends is nearer; only priors and
    perspective can. Rotation vectors (x, y, z) become (-x, -y, z), and what couples the thickness
    to the rest changes its sign.
    """
    mirrored = flat.copy()
    mirrored[:2] *= -1
    joints = mirrored[ROOT:].reshape(-1, JOINT)
    joints[:, [0, 1, 5, 11, 12]] *= -1
    return mirrored
