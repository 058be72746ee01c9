"""The mean shape of a stock, from frames of its fish: a bundle adjustment with a prior.

Of every frame the pose is free; all fish of a stock share its shape s, from which individuals
differ by a known covariance. At given poses the normal equations of a frame (`equations.py`) have
the pose eliminated by a Schur complement, as in bundle adjustment (Triggs et al., "Bundle
Adjustment: a Modern Synthesis", 2000); the frames of a fish are averaged, for they are much alike;
its own deviation is integrated out, which leaves each fish a Gaussian in s. Their product with the
prior about a body form is solved, the template reshaped, the poses followed, and so on.

The best pose is not the mean one: a body that is too broad can always roll a little, one that is
too narrow cannot. What the volume of likely poses around the best one changes with the shape is
therefore counted as well (Laplace's method), with the weight that it has in the scan of sizes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.levenberg_marquardt import WARM_DAMPING, minimise
from stream_dmr.fitting.contour.problem import Options, Problem
from stream_dmr.fitting.contour.rotation_vector import rotation_and_jacobian
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.parameters import ROOT_ROTATION
from stream_dmr.fitting.shape.equations import shape_equations
from stream_dmr.fitting.shape.space import (
    BREADTH,
    LOBES,
    NUM_COEFFICIENTS,
    THICKNESS,
    directions,
    form_precision,
    individual_covariance,
    reshaped,
)
from stream_dmr.fitting.size.scanner import LOG_VOLUME_WEIGHT
from stream_dmr.fitting.target import Target
from stream_dmr.template.template import Template

# Fish of a stock hang nearer to the plane on average than any one of them.
_TILT_STD_RAD = 0.15
# Within which the roll about the fish's own axis may hide, where an outline says nothing of it.
_ROLL_STD_RAD = 0.5
# Chosen by trial, as the limits below.
_MAX_ROUNDS = 12
_MAX_STEP = 0.25  # of a log factor in one round: directions are those of the shape at hand
_SETTLED = 0.01  # of a log factor
_MAX_SHIFT = 0.15  # by log volumes, which are known to first order only
_PROBE = 0.05  # step of the finite difference of log volumes
_POSE_OPTIONS = Options(6, 1e-5, WARM_DAMPING)


@dataclass(eq=False)
class PosedTarget:
    """One frame of a fish: what is fitted to, and the pose, which follows the shape."""

    fish: int
    target: Target
    pose: Float[np.ndarray, "P"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Stock:
    """A mean shape with what is not known of it."""

    coefficients: Float[np.ndarray, "W"]
    covariance: Float[np.ndarray, "W W"]
    nats: dict[int, float]  # of each fish: mean loss of its frames as negative log likelihood


class StockFitter:
    """Learns mean shapes on one template with one set of settings."""

    def __init__(self, template: Template, settings: FitMeshSettings) -> None:
        self._template = template
        self._nat = settings.nat
        tilt_std_rad = min(settings.tilt_std_rad, _TILT_STD_RAD)
        self._settings = settings.model_copy(update={"tilt_std_rad": tilt_std_rad})
        self._precision = form_precision()
        self._individual = np.linalg.inv(individual_covariance())

    def fit(
        self,
        frames: Sequence[PosedTarget],
        form: Float[np.ndarray, "W"],
        start: Float[np.ndarray, "W"],
        *,
        with_volumes: bool = False,
    ) -> Stock:
        """The shape of the fish of these frames, a priori near a body form; poses follow it.

        `with_volumes` counts the volume of likely poses, for a last fit: it takes four more rounds.
        """
        shape, inverse = start.copy(), np.eye(NUM_COEFFICIENTS)
        for _ in range(_MAX_ROUNDS):
            A, b = self._equations(frames, shape)
            A += self._precision
            b -= self._precision @ (shape - form)
            inverse = cho_solve(cho_factor((A + A.T) / 2), np.eye(len(A)))
            step = inverse @ b
            step /= max(1.0, np.abs(step[:LOBES]).max() / _MAX_STEP)
            shape += step
            if np.abs(step).max() < _SETTLED:
                break
        if with_volumes:
            shape += self._volume_shift(frames, shape, inverse)
        return Stock(coefficients=shape, covariance=inverse, nats=self.nats(frames, shape))

    def nats(
        self, frames: Sequence[PosedTarget], shape: Float[np.ndarray, "W"]
    ) -> dict[int, float]:
        """Mean loss of each fish's frames as negative log likelihood; poses follow the shape."""
        body = Body.from_template(reshaped(self._template, shape))
        losses: dict[int, list[float]] = {}
        for frame in frames:
            loss, _ = self._follow(body, frame)
            losses.setdefault(frame.fish, []).append(loss / self._nat)
        return {fish: float(np.mean(values)) for fish, values in losses.items()}

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
            fish.setdefault(frame.fish, []).append(_without_pose(found.H, found.g, len(frame.pose)))
        A, b = np.zeros((NUM_COEFFICIENTS, NUM_COEFFICIENTS)), np.zeros(NUM_COEFFICIENTS)
        for parts in fish.values():
            H = np.mean([part[0] for part in parts], axis=0) / self._nat
            g = np.mean([part[1] for part in parts], axis=0) / self._nat
            # With the individual's deviation d ~ N(0, C) integrated out, H - H (H + C^-1)^-1 H.
            shrink = np.eye(len(H)) - H @ np.linalg.inv(H + self._individual)
            A += shrink @ H
            b -= shrink @ g
        return A, b

    def _volume_shift(
        self,
        frames: Sequence[PosedTarget],
        shape: Float[np.ndarray, "W"],
        covariance: Float[np.ndarray, "W W"],
    ) -> Float[np.ndarray, "W"]:
        """How far the log volumes of likely poses move the shape: a Newton step, no more."""
        slope = np.zeros(NUM_COEFFICIENTS)
        for part in (BREADTH, THICKNESS):  # the shape as a whole: its details hardly matter here
            way = np.zeros(NUM_COEFFICIENTS)
            way[part] = 1.0
            more, less = (self._log_volume(frames, shape + s * way) for s in (_PROBE, -_PROBE))
            slope += way * (more - less) / (2 * _PROBE) / way.sum()
        shift = -LOG_VOLUME_WEIGHT * covariance @ slope
        return shift * min(1.0, _MAX_SHIFT / max(np.abs(shift[:LOBES]).max(), 1e-9))

    def _log_volume(self, frames: Sequence[PosedTarget], shape: Float[np.ndarray, "W"]) -> float:
        """Half the log determinants of the poses' curvature, averaged over each fish's frames."""
        body = Body.from_template(reshaped(self._template, shape))
        volumes: dict[int, list[float]] = {}
        for frame in frames:
            before = frame.pose
            _, H = self._follow(body, frame)
            roll = _roll_slope(frame.pose)
            H = H / self._nat + np.outer(roll, roll) / _ROLL_STD_RAD**2 + 1e-9 * np.eye(len(H))
            volumes.setdefault(frame.fish, []).append(0.5 * float(np.linalg.slogdet(H)[1]))
            frame.pose = before
        return sum(float(np.mean(values)) for values in volumes.values())

    def _follow(self, body: Body, frame: PosedTarget) -> tuple[float, Float[np.ndarray, "P P"]]:
        """Refit a frame from its last pose; its loss and the loss's curvature."""
        problem = self._problem(body, frame.target)
        nothing_held = np.zeros(len(frame.pose), np.bool_)
        found = minimise(problem, frame.pose, nothing_held, _POSE_OPTIONS)
        frame.pose = found.parameters
        return found.loss, found.H

    def _problem(self, body: Body, target: Target) -> Problem:
        return Problem.from_settings(self._settings, body, target, with_smoothness=False)


def _without_pose(
    H: Float[np.ndarray, "Z Z"], g: Float[np.ndarray, "Z"], num_pose: int
) -> tuple[Float[np.ndarray, "W W"], Float[np.ndarray, "W"]]:
    """The Schur complement: curvature and slope of the loss in the shape, the pose at its best."""
    pose, shape = slice(0, num_pose), slice(num_pose, None)
    factor = cho_factor(H[pose, pose] + 1e-9 * np.eye(num_pose))
    gain = cho_solve(factor, H[pose, shape])
    return H[shape, shape] - H[shape, pose] @ gain, g[shape] - gain.T @ g[pose]


def _roll_slope(pose: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """Slope of the roll about the body's own axis to the pose.

    The first row of the right Jacobian of SO(3): x is the body's axis (Sola et al., 2018, eq. 143).
    """
    _, J = rotation_and_jacobian(pose[ROOT_ROTATION])
    slope = np.zeros(len(pose))
    slope[ROOT_ROTATION] = J[0]
    return slope
