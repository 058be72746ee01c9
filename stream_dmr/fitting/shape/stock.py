"""The mean shape of a stock, from frames of its fish: a bundle adjustment with a prior.

Of every frame the pose is free; all fish of a stock share its shape s, from which individuals
differ by a known covariance. At given poses the normal equations of a frame (`equations.py`) have
the pose eliminated by a Schur complement, as in bundle adjustment (Triggs et al., "Bundle
Adjustment: a Modern Synthesis", 2000); the frames of a fish are averaged, for they are much alike;
its own deviation is integrated out, which leaves each fish a Gaussian in s. Their product with the
prior about a body form is solved, the template reshaped, the poses followed, and so on.

What roll hides (`roll.py`) has several such solutions. `best` begins from the poses as they are and
from unrolled ones, and takes what the masks agree with better in all poses (`evidence.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.levenberg_marquardt import WARM_DAMPING, minimise
from stream_dmr.fitting.contour.problem import Options, Problem
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.equations import ShapeEquations, shape_equations
from stream_dmr.fitting.shape.evidence import nats_against
from stream_dmr.fitting.shape.roll import ROLL_STD_RAD, narrowed, roll_rad, roll_slope, unrolled
from stream_dmr.fitting.shape.space import (
    BREADTH,
    LOBES,
    NUM_COEFFICIENTS,
    directions,
    form_precision,
    individual_covariance,
    reshaped,
)
from stream_dmr.fitting.target import Target
from stream_dmr.template.template import Template

# Fish of a stock hang nearer to the plane on average than any one of them.
_TILT_STD_RAD = 0.15
# Of the breadth as a whole: what roll and slant hide, to which the equations are blind, since both
# show in second order only. As wrong as stocks of seven simulated species were (docs/research).
_HIDDEN_BREADTH_STD = 0.06
# Chosen by trial, as the limits below.
_MAX_ROUNDS = 12
_MAX_STEP = 0.25  # of a log factor in one round: directions are those of the shape at hand
_SETTLED = 0.01  # of a log factor
_POSE_OPTIONS = Options(6, 1e-5, WARM_DAMPING)


@dataclass(eq=False)
class PosedTarget:
    """One frame of a fish: what is fitted to, and the pose, which follows the shape."""

    fish: int
    target: Target
    pose: Float[np.ndarray, "P"]

    def copy(self) -> "PosedTarget":
        """One whose pose may follow another shape."""
        return PosedTarget(self.fish, self.target, self.pose)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stock:
    """A mean shape with what is not known of it."""

    coefficients: Float[np.ndarray, "W"]
    covariance: Float[np.ndarray, "W W"]
    nats: dict[int, float]  # of each fish: mean of its frames, see `evidence.nats_against`
    frames: list[PosedTarget]  # with the poses that go with this shape


class StockFitter:
    """Learns mean shapes on one template with one set of settings."""

    def __init__(self, template: Template, settings: FitMeshSettings) -> None:
        self._template = template
        self._nat = settings.nat
        tilt_std_rad = min(settings.tilt_std_rad, _TILT_STD_RAD)
        self._settings = settings.model_copy(update={"tilt_std_rad": tilt_std_rad})
        self._precision = form_precision()
        self._individual = np.linalg.inv(individual_covariance())

    def best(
        self,
        frames: Sequence[PosedTarget],
        form: Float[np.ndarray, "W"],
        start: Float[np.ndarray, "W"],
    ) -> Stock:
        """The likelier one of two fits: from the poses as they are, and from unrolled ones."""
        rolls = [abs(roll_rad(frame.pose, frame.target.anchor)) for frame in frames]
        flat = [
            PosedTarget(frame.fish, frame.target, unrolled(frame.pose, frame.target.anchor))
            for frame in frames
        ]
        narrow = narrowed(self._template, start, float(np.median(rolls)))
        found = [self.fit(frames, form, start), self.fit(flat, form, narrow)]
        return min(found, key=lambda stock: self._against(stock, form))

    def fit(
        self,
        frames: Sequence[PosedTarget],
        form: Float[np.ndarray, "W"],
        start: Float[np.ndarray, "W"],
    ) -> Stock:
        """The shape of the fish of these frames, a priori near a body form."""
        posed = [frame.copy() for frame in frames]
        shape, inverse = start.copy(), np.eye(NUM_COEFFICIENTS)
        for _ in range(_MAX_ROUNDS):
            A, b = self._equations(posed, shape)
            A += self._precision
            b -= self._precision @ (shape - form)
            inverse = cho_solve(cho_factor((A + A.T) / 2), np.eye(len(A)))
            step = _limited(inverse @ b)
            shape += step
            if np.abs(step).max() < _SETTLED:
                break
        nats = self.nats(posed, shape)
        inverse[BREADTH, BREADTH] += _HIDDEN_BREADTH_STD**2
        return Stock(coefficients=shape, covariance=inverse, nats=nats, frames=posed)

    def nats(
        self, frames: Sequence[PosedTarget], shape: Float[np.ndarray, "W"]
    ) -> dict[int, float]:
        """What each fish's frames say against a shape, on average; their poses follow it."""
        body = Body.from_template(reshaped(self._template, shape))
        against: dict[int, list[float]] = {}
        for frame in frames:
            self._follow(body, frame)
            problem = self._problem(body, frame.target)
            against.setdefault(frame.fish, []).append(
                nats_against(problem, frame.pose, nat=self._nat)
            )
        return {fish: float(np.mean(values)) for fish, values in against.items()}

    def _against(self, stock: Stock, form: Float[np.ndarray, "W"]) -> float:
        """-log of the posterior of a stock, up to a constant."""
        off = stock.coefficients - form
        return sum(stock.nats.values()) + 0.5 * float(off @ self._precision @ off)

    def _equations(
        self, frames: Sequence[PosedTarget], shape: Float[np.ndarray, "W"]
    ) -> tuple[Float[np.ndarray, "W W"], Float[np.ndarray, "W"]]:
        """Information of all fish on the shape, A, and its gradient, b: the step is A^-1 b."""
        body = Body.from_template(reshaped(self._template, shape))
        slopes = directions(body)
        fish: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
        for frame in frames:
            self._follow(body, frame)
            found = shape_equations(self._problem(body, frame.target), frame.pose, slopes)
            parts = _without_pose(*self._with_roll(found, frame), len(frame.pose))
            fish.setdefault(frame.fish, []).append(parts)
        A, b = np.zeros((NUM_COEFFICIENTS, NUM_COEFFICIENTS)), np.zeros(NUM_COEFFICIENTS)
        for parts in fish.values():
            H = np.mean([part[0] for part in parts], axis=0) / self._nat
            g = np.mean([part[1] for part in parts], axis=0) / self._nat
            # With the individual's deviation d ~ N(0, C) integrated out, H - H (H + C^-1)^-1 H.
            shrink = np.eye(len(H)) - H @ np.linalg.inv(H + self._individual)
            A += shrink @ H
            b -= shrink @ g
        return A, b

    def _with_roll(
        self, found: ShapeEquations, frame: PosedTarget
    ) -> tuple[Float[np.ndarray, "Z Z"], Float[np.ndarray, "Z"]]:
        """H and g with the prior of the roll."""
        H, g = found.H.copy(), found.g.copy()
        roll = roll_rad(frame.pose, frame.target.anchor)
        slope = roll_slope(frame.pose, frame.target.anchor)
        weight, pose = self._nat / ROLL_STD_RAD**2, slice(0, len(slope))
        H[pose, pose] += weight * np.outer(slope, slope)
        g[pose] += weight * roll * slope
        return H, g

    def _follow(self, body: Body, frame: PosedTarget) -> None:
        """Refit a frame from its last pose."""
        problem = self._problem(body, frame.target)
        nothing_held = np.zeros(len(frame.pose), np.bool_)
        frame.pose = minimise(problem, frame.pose, nothing_held, _POSE_OPTIONS).parameters

    def _problem(self, body: Body, target: Target) -> Problem:
        return Problem.from_settings(self._settings, body, target, with_smoothness=False)


def _limited(step: Float[np.ndarray, "W"]) -> Float[np.ndarray, "W"]:
    return step / max(1.0, float(np.abs(step[:LOBES]).max()) / _MAX_STEP)


def _without_pose(
    H: Float[np.ndarray, "Z Z"], g: Float[np.ndarray, "Z"], num_pose: int
) -> tuple[Float[np.ndarray, "W W"], Float[np.ndarray, "W"]]:
    """The Schur complement: curvature and slope of the loss in the shape, the pose at its best."""
    pose, shape = slice(0, num_pose), slice(num_pose, None)
    factor = cho_factor(H[pose, pose] + 1e-9 * np.eye(num_pose))
    gain = cho_solve(factor, H[pose, shape])
    return H[shape, shape] - H[shape, pose] @ gain, g[shape] - gain.T @ g[pose]
