"""The mean shape of a stock, from frames of its fish: a bundle adjustment with a prior.

The pose of every frame is free; all fish of a stock share its shape s, from which individuals
differ by a known covariance. At given poses the least-squares problem of a frame over pose and
shape together has the pose eliminated by a Schur complement (Triggs et al., "Bundle Adjustment: a
Modern Synthesis", 2000); the frames of a fish are averaged, as they are much alike; its own
deviation is integrated out, which leaves each fish a Gaussian in s. Their product with the prior
about a body form is solved, the template reshaped, the poses refitted, and so on.

A fish that is rolled by r about its own axis shows the breadth sqrt(b^2 cos^2 r + t^2 sin^2 r),
with its breadth b and its thickness t. So a body that is too broad fits nearly as well, rolled away
from the camera or arched, and no step of a descent leads back, since shape and pose would have to
change together. Shapes are therefore learnt from square fits, as if fish were neither rolled,
slanted, twisted nor arched: first from all frames, then from frames that show the fish's broad
side. The factors on breadth and thickness that turned fish hide are inferred for all fish at once
(`space.infer_proportions`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from stream_dmr.compiled import compiled
from stream_dmr.fitting.body import LOG_SIZE, ROOT_ROTATION, Body, joints_of
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.space import (
    BREADTH,
    LOBES,
    MEAN_THICKNESS,
    NUM_COEFFICIENTS,
    THICKNESS,
    TRUNK,
    Proportions,
    directions,
    form_precision,
    individual_covariance,
    infer_proportions,
    reshaped,
    roundness,
    std_of,
    with_std_of,
)
from stream_dmr.fitting.size import nats_against
from stream_dmr.fitting.solver.descent import WARM_DAMPING, descend, evaluate, weighted_squares
from stream_dmr.fitting.solver.linear_blend import (
    blend,
    cholesky_factors,
    dot,
    fill_rotation,
    rotation_and_jacobian,
    skinning_weights,
)
from stream_dmr.fitting.solver.outline import (
    Rendering,
    RimSlopes,
    contour_residuals,
    pixel_slopes,
    rim_vertices,
    visible_rim,
)
from stream_dmr.fitting.solver.problem import Options, Problem, regularise, roll_and_slope
from stream_dmr.fitting.solver.spine import jacobian
from stream_dmr.fitting.target import Target
from stream_dmr.template.template import Template


def unrolled(
    pose: Float[np.ndarray, "P"], anchor: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "P"]:
    """The pose turned about the body's axis until the broad side faces the camera."""
    # A copy: for the read-only arrays of messages numba would compile it once more.
    return _turned(pose, roll_and_slope(pose.copy(), anchor)[0])


def rolled_as_seen(
    pose: Float[np.ndarray, "P"], log_breadth: float, roundness: float
) -> Float[np.ndarray, "P"]:
    """An unrolled pose, rolled until this factor of the breadth is seen, as far as roll can.

    `roundness` is the thickness of the body over its breadth.
    """
    seen = np.clip(np.exp(2 * log_breadth), min(roundness**2, 1.0), 1.0)
    roll = np.arcsin(np.sqrt((1 - seen) / max(1 - roundness**2, 1e-9)).clip(0, 1))
    return _turned(pose, -float(roll))


def _turned(pose: Float[np.ndarray, "P"], angle: float) -> Float[np.ndarray, "P"]:
    turned = pose.copy()
    turn = Rotation.from_rotvec(turned[ROOT_ROTATION]) * Rotation.from_euler("x", angle)
    turned[ROOT_ROTATION] = turn.as_rotvec()
    return turned


# Stds of priors that hold angles near zero; chosen so that none of them can hide a per cent.
_HELD_ROLL_RAD, _HELD_TILT_RAD = 0.03, 0.02
_HELD_TWIST_RAD, _HELD_ARCH_RAD = 0.05, 0.05
_ARCH = 1  # of a joint's rotation: about the axis across the fish, out of the picture
_OPTIONS = Options(iterations=12, tolerance=1e-6, damping=1e-3)


def square_problem(
    settings: FitMeshSettings,
    body: Body,
    target: Target,
    *,
    scale_std: float,
    arch_std_rad: float = _HELD_ARCH_RAD,
) -> Problem:
    """The problem of a square fit; joints' log scales and bends out of the picture have a std."""
    held = settings.model_copy(
        update={
            "tilt_std_rad": _HELD_TILT_RAD,
            "twist_std_rad": _HELD_TWIST_RAD,
            "lambda_scale": settings.nat / (2 * scale_std**2),
        }
    )
    problem = Problem.from_settings(held, body, target, with_smoothness=False)
    joint = problem.priors.joint.copy()
    joint[_ARCH] = settings.prior_weight / arch_std_rad**2
    roll = settings.nat / _HELD_ROLL_RAD**2
    return problem._replace(priors=problem.priors._replace(joint=joint, roll=roll))


def square_pose(problem: Problem, pose: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P"]:
    """The pose of a square fit, searched from an unrolled one."""
    return descend(problem, pose, np.zeros(len(pose), np.bool_), _OPTIONS).parameters


class ShapeEquations(NamedTuple):
    """E(pose + x, shape + y) = E + g z + z H z / 2, with z = (x, y)."""

    H: Float[np.ndarray, "Z Z"]
    g: Float[np.ndarray, "Z"]


def shape_equations(
    problem: Problem, parameters: Float[np.ndarray, "P"], directions: Float[np.ndarray, "V 3 W"]
) -> ShapeEquations:
    """H and g of a fit by the spine; `directions` are of its body's vertices."""
    rendering = evaluate(problem, parameters, False).rendering  # compiled once, for all
    return _equations(problem, parameters, rendering, directions)


@compiled
def _equations(
    problem: Problem,
    parameters: Float[np.ndarray, "P"],
    rendering: Rendering,
    directions: Float[np.ndarray, "V 3 W"],
) -> ShapeEquations:
    visible = visible_rim(rendering)
    row_of, chosen = rim_vertices(problem.body.num_vertices, visible.edges)
    num_pose, num_shape = len(parameters), directions.shape[2]
    slopes = np.empty((len(chosen), 3, num_pose + num_shape))
    to_pose = jacobian(problem.body, problem.kind, parameters, chosen)
    for c in range(len(chosen)):
        for i in range(3):
            for p in range(num_pose):
                slopes[c, i, p] = to_pose[c, i, p]
    _carry(problem.body, parameters, directions, chosen, slopes[:, :, num_pose:])
    moved = RimSlopes(row_of, pixel_slopes(rendering.points, chosen, slopes, problem.target))
    H, g = weighted_squares(contour_residuals(problem.target, rendering.pixels, visible, moved))
    pose_H, pose_g = np.zeros((num_pose, num_pose)), np.zeros(num_pose)
    regularise(problem, parameters, pose_H, pose_g)
    for p in range(num_pose):
        g[p] += pose_g[p]
        for q in range(num_pose):
            H[p, q] += pose_H[p, q]
    return ShapeEquations(H, g)


@compiled
def _carry(
    body: Body,
    parameters: Float[np.ndarray, "P"],
    directions: Float[np.ndarray, "V 3 W"],
    chosen: Int[np.ndarray, "C"],
    out: Float[np.ndarray, "C 3 W"],
) -> None:
    """Carry directions at rest into the deformed body, as `spine_points` carries offsets."""
    joints, num_joints = joints_of(parameters), len(body.joints)
    L, S = cholesky_factors(joints.weight), np.exp(joints.log_scale)
    W, dE = np.empty(num_joints), np.empty((num_joints, 6))
    blended, turned = np.empty(3), np.empty((3, 3))
    root, _ = rotation_and_jacobian(parameters[ROOT_ROTATION])
    size = np.exp(parameters[LOG_SIZE])
    for c in range(len(chosen)):
        n = chosen[c]
        skinning_weights(body.places[body.place_of[n]], body.joints, L, W, dE)
        blend(W, joints.rotation, blended)
        fill_rotation(blended, turned)
        scale = size * dot(W, S)
        for i in range(3):
            for k in range(out.shape[2]):
                out[c, i, k] = 0.0
            for m in range(3):
                carried = 0.0
                for j in range(3):
                    carried += root[i, j] * turned[j, m]
                for k in range(out.shape[2]):
                    out[c, i, k] += scale * carried * directions[n, m, k]


# Fish of a stock hang that way more nearly on average than any single fish does.
_TILT_STD_RAD = 0.15
# Stds of the joints' log scales in a square fit: while the outline is learnt, and while the breadth
# is read off. Chosen.
_LEARNING_SCALE_STD, _READING_SCALE_STD = 0.1, 0.4
# Chosen by trial, as the limits below.
_MAX_ROUNDS = 12
_BROADSIDE, _FEWEST_BROADSIDE = 0.12, 6  # log factor, frames
_MAX_STEP = 0.25  # of a log factor in one round: the directions are of the present shape
_SETTLED = 0.01  # of a log factor
_POSE_OPTIONS = Options(6, 1e-5, WARM_DAMPING)


@dataclass(eq=False)
class PosedTarget:
    """One frame of a fish: its target, and its pose, which is refitted with the shape."""

    fish: int
    target: Target
    pose: Float[np.ndarray, "P"]

    def unrolled(self) -> "PosedTarget":
        """A copy whose broad side faces the camera."""
        return replace(self, pose=unrolled(self.pose, self.target.anchor))


class FormOdds(NamedTuple):
    """The body forms that fish may be of."""

    coefficients: Float[np.ndarray, "K W"]
    shares: Float[np.ndarray, "K"]  # how probable each is; sum to 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Stock:
    """A mean shape with its covariance."""

    coefficients: Float[np.ndarray, "W"]
    covariance: Float[np.ndarray, "W W"]
    nats: dict[int, float]  # of each fish: mean of its frames, see `size.nats_against`
    frames: list[PosedTarget]  # with the poses that go with this shape


class StockFitter:
    """Learns mean shapes on one template with one set of settings."""

    def __init__(self, template: Template, settings: FitMeshSettings) -> None:
        self._template = template
        self._nat = settings.nat
        tilt_std_rad = min(settings.tilt_std_rad, _TILT_STD_RAD)
        self._settings = settings.model_copy(update={"tilt_std_rad": tilt_std_rad})
        self._slant_std_rad = settings.tilt_std_rad
        self._precision = form_precision()
        self._individual = np.linalg.inv(individual_covariance())

    def fit(
        self,
        frames: Sequence[PosedTarget],
        form: Float[np.ndarray, "W"],
        start: Float[np.ndarray, "W"],
        odds: FormOdds | None = None,
    ) -> Stock:
        """The shape of the fish of these frames, a priori near a body form.

        The outline is near that of `form`; breadth and thickness, which turned fish hide, may be
        near any of `odds` (default: that form alone).
        """
        odds = odds or FormOdds(form[None], np.ones(1))
        shape, _ = self._outline(frames, form, start)
        _, seen, known = self._read(frames, shape, odds)
        shape, inverse = self._outline(_broadside(frames, seen - known.breadth), form, shape)
        square, seen, known = self._read(frames, shape, odds)
        shape[BREADTH] += known.breadth
        shape[THICKNESS] += known.thickness
        inverse = with_std_of(inverse, BREADTH, TRUNK, known.breadth_std)
        inverse = with_std_of(inverse, THICKNESS, MEAN_THICKNESS, known.thickness_std)
        nats, posed = self._placed(frames, square, seen - known.breadth, shape)
        return Stock(coefficients=shape, covariance=inverse, nats=nats, frames=posed)

    def _outline(
        self,
        frames: Sequence[PosedTarget],
        form: Float[np.ndarray, "W"],
        start: Float[np.ndarray, "W"],
    ) -> tuple[Float[np.ndarray, "W"], Float[np.ndarray, "W W"]]:
        """The shape that these frames show squarely, and its covariance."""
        square = [frame.unrolled() for frame in frames]
        shape, inverse = start.copy(), np.eye(NUM_COEFFICIENTS)
        for _ in range(_MAX_ROUNDS):
            A, b = self._equations(square, shape)
            A += self._precision
            b -= self._precision @ (shape - form)
            inverse = cho_solve(cho_factor((A + A.T) / 2), np.eye(len(A)))
            step: np.ndarray = inverse @ b
            step /= max(1.0, float(np.abs(step[:LOBES]).max()) / _MAX_STEP)
            shape += step
            if np.abs(step).max() < _SETTLED:
                break
        return shape, inverse

    def nats(
        self, frames: Sequence[PosedTarget], shape: Float[np.ndarray, "W"]
    ) -> dict[int, float]:
        """Each fish's mean nats against a shape; the poses of its frames are refitted."""
        body = Body.from_template(reshaped(self._template, shape))
        against: dict[int, list[float]] = {}
        for frame in frames:
            against.setdefault(frame.fish, []).append(self._follow(body, frame))
        return _means(against)

    def _read(
        self, frames: Sequence[PosedTarget], shape: Float[np.ndarray, "W"], odds: FormOdds
    ) -> tuple[list[PosedTarget], Float[np.ndarray, "F"], Proportions]:
        """Read each frame's breadth off a square fit that may be arched, and infer the stock's.

        Returns the fits, the logs of the factors on the breadth, and the stock's proportions.
        """
        template = reshaped(self._template, shape)
        body, square = Body.from_template(template), [frame.unrolled() for frame in frames]
        by_fish, seen = dict[int, list[float]](), list[float]()
        for frame in square:
            problem = square_problem(
                self._settings,
                body,
                frame.target,
                scale_std=_READING_SCALE_STD,
                arch_std_rad=self._settings.arch_std_rad,
            )
            frame.pose = square_pose(problem, frame.pose)
            seen.append(float(joints_of(frame.pose).log_scale.mean()))
            by_fish.setdefault(frame.fish, []).append(seen[-1])
        spread = np.linalg.inv(self._precision)
        breadth_std, thickness_std = std_of(TRUNK, spread), std_of(MEAN_THICKNESS, spread)
        known = infer_proportions(
            by_fish,
            roundness=roundness(template),
            slant_std_rad=self._slant_std_rad,
            before=[
                Proportions(
                    float(TRUNK @ off),
                    breadth_std,
                    float(MEAN_THICKNESS @ off),
                    thickness_std,
                    share,
                )
                for off, share in zip(odds.coefficients - shape, odds.shares.tolist(), strict=True)
            ],
        )
        return square, np.array(seen), known

    def _placed(
        self,
        frames: Sequence[PosedTarget],
        square: Sequence[PosedTarget],
        seen: Float[np.ndarray, "F"],
        shape: Float[np.ndarray, "W"],
    ) -> tuple[dict[int, float], list[PosedTarget]]:
        """Each fish's nats against a shape, and the better of two poses of each frame.

        Poses are refitted from where the frame was found, and from the square pose, rolled by as
        much as the seen breadth implies.
        """
        template = reshaped(self._template, shape)
        body, thin = Body.from_template(template), roundness(template)
        against: dict[int, list[float]] = {}
        placed: list[PosedTarget] = []
        for frame, flat, log_breadth in zip(frames, square, seen, strict=True):
            rolled = rolled_as_seen(flat.pose, float(log_breadth), thin)
            joints_of(rolled).log_scale[:] = 0.0
            starts = replace(frame), replace(frame, pose=rolled)
            nats = [self._follow(body, start) for start in starts]
            best = int(np.argmin(nats))
            placed.append(starts[best])
            against.setdefault(frame.fish, []).append(nats[best])
        return _means(against), placed

    def _equations(
        self, frames: Sequence[PosedTarget], shape: Float[np.ndarray, "W"]
    ) -> tuple[Float[np.ndarray, "W W"], Float[np.ndarray, "W"]]:
        """Information of all fish on the shape, A, and its gradient, b: the step is A^-1 b."""
        body = Body.from_template(reshaped(self._template, shape))
        slopes = directions(body)
        fish: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
        for frame in frames:
            problem = square_problem(
                self._settings, body, frame.target, scale_std=_LEARNING_SCALE_STD
            )
            frame.pose = square_pose(problem, frame.pose)
            H, g = shape_equations(problem, frame.pose, slopes)
            if parts := without_pose(H, g, len(frame.pose)):
                fish.setdefault(frame.fish, []).append(parts)
        A, b = np.zeros((NUM_COEFFICIENTS, NUM_COEFFICIENTS)), np.zeros(NUM_COEFFICIENTS)
        for parts in fish.values():
            H = np.mean([part[0] for part in parts], axis=0) / self._nat
            g = np.mean([part[1] for part in parts], axis=0) / self._nat
            information, slope = without_deviation(H, g, self._individual)
            A += information
            b -= slope
        return A, b

    def _follow(self, body: Body, frame: PosedTarget) -> float:
        """Refit a frame from its last pose; return its mask's nats against the shape."""
        problem = Problem.from_settings(self._settings, body, frame.target, with_smoothness=False)
        nothing_held = np.zeros(len(frame.pose), np.bool_)
        frame.pose = descend(problem, frame.pose, nothing_held, _POSE_OPTIONS).parameters
        return nats_against(problem, frame.pose, nat=self._nat)


def _broadside(frames: Sequence[PosedTarget], off: Float[np.ndarray, "F"]) -> Sequence[PosedTarget]:
    """The frames that show about the whole breadth, or the frames nearest to it.

    `off`: log of each seen breadth over the stock's. Edge-on, the outline is the thickness.
    """
    order = np.argsort(np.abs(off), kind="stable")
    num = max(int((np.abs(off) < _BROADSIDE).sum()), _FEWEST_BROADSIDE)
    return [frames[n] for n in np.sort(order[:num])]


def _means(values: dict[int, list[float]]) -> dict[int, float]:
    return {fish: float(np.mean(each)) for fish, each in values.items()}


def without_deviation(
    H: Float[np.ndarray, "W W"], g: Float[np.ndarray, "W"], precision: Float[np.ndarray, "W W"]
) -> tuple[Float[np.ndarray, "W W"], Float[np.ndarray, "W"]]:
    """Curvature and slope in the stock's shape, an individual's deviation from it integrated out.

    (H^-1 + C)^-1 = H - H (H + C^-1)^-1 H for a deviation N(0, C) of precision C^-1, written so that
    the H of a mask unlike any fish, which reaches 1e11, cancels nothing.
    """
    shrink = np.linalg.solve(H + precision, precision).T
    return precision - shrink @ precision, shrink @ g


def without_pose(
    H: Float[np.ndarray, "Z Z"], g: Float[np.ndarray, "Z"], num_pose: int
) -> tuple[Float[np.ndarray, "W W"], Float[np.ndarray, "W"]] | None:
    """The Schur complement: curvature and slope of the loss in the shape, the pose at its best.

    None if a mask unlike any fish leaves a pose without a minimum; it has no information.
    """
    pose, shape = slice(0, num_pose), slice(num_pose, None)
    try:
        factor = cho_factor(H[pose, pose] + 1e-9 * np.eye(num_pose))
    except np.linalg.LinAlgError:
        return None
    gain = cho_solve(factor, H[pose, shape])
    return H[shape, shape] - H[shape, pose] @ gain, g[shape] - gain.T @ g[pose]
