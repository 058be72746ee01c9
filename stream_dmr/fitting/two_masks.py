"""One mesh to the masks of two cameras: both contours are one least-squares problem.

The mesh bends, turns and grows once for both; each picture has its own place of it, since the
cameras are never quite in step. Where the two rays to its center meet gives its distances from the
cameras, and with them its size in each picture.

What one camera's mask lacks, as a tail behind the body, the other's shows, and the breadth in both
tells how long such a fish is. Two masks tell more of a bend than one: the mesh gets a joint more
than most templates have.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.body import (
    LOG_SIZE,
    NUM_ROOT,
    ROOT_ROTATION,
    ROOT_TRANSLATION,
    Body,
    MeshLevels,
    joints_of,
    rest_vector,
)
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.fitting.shape.space import TRUNK, reshaped, std_of
from stream_dmr.fitting.solver.contour_solver import mirror
from stream_dmr.fitting.solver.descent import (
    GROWTH,
    MAX_REFUSED,
    SHRINK,
    WARM_DAMPING,
    Iterate,
    evaluate,
    normal_equations,
)
from stream_dmr.fitting.solver.linear_blend import (
    cholesky_factors,
    rotation_and_jacobian,
    skinning_weights,
)
from stream_dmr.fitting.solver.problem import SCALE, TRANSLATION, Problem, prior_loss
from stream_dmr.fitting.target import TOWARD_CAMERA, Target
from stream_dmr.fitting.uncertainty import freed
from stream_dmr.geometry import points_along
from stream_dmr.messages import FishCrop, FittedShape
from stream_dmr.template.template import Template

_JOINTS = (1 / 6, 1 / 2, 5 / 6)  # of the mesh, as shares of its midline
_TRIED = 3  # starts, the likeliest; all others end in the same poses (measured)
_ROUGH_ITERATIONS, _ITERATIONS = 8, 30  # on half the resolution, and on all of it
_ROUNDS = 3  # after each, distances and the weights of the pictures are taken anew
_USUAL_MISSING = 0.08  # 1 - IoU of a good fit: a mask that is followed worse weighs less


class Sight(NamedTuple):
    """A fish in one camera's picture."""

    crop: FishCrop
    shape: FittedShape  # its fit by this camera alone
    drift: Float[np.ndarray, "3"]  # how far the ray to its center moves until the moment


class CommonMesh(NamedTuple):
    """The mesh that fits both masks."""

    midline_mm: Float[np.ndarray, "M 3"]  # in the first camera's frame
    iou: float  # with the mask that it fits worse


class TwoMaskFitter:
    """Fits a run's shapes to the masks of two cameras; keeps no state of any fish."""

    def __init__(
        self,
        template: Template,
        candidates: CandidateShapes | None,
        settings: FitMeshSettings,
        *,
        second_joints: Float[np.ndarray, "J 3"],
        second_from_first: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]],
    ) -> None:
        """`second_joints`: those of the second run's template, by which its fits bend.

        `second_from_first`: R and t (mm) from the first camera's frame to the second's.
        """
        self._R, self._t_mm = second_from_first
        self._joints = template.joints.copy(), second_joints.copy()
        shapes = [*candidates] if candidates is not None else []

        @cache
        def levels(index: int | None) -> tuple[MeshLevels, FitMeshSettings]:
            shape, free = template, settings
            if index is not None:
                shape = reshaped(template, shapes[index].coefficients)
                free = freed(settings, std_of(TRUNK, shapes[index].covariance) ** 2)
            jointed = replace(shape, joints=points_along(shape.midline, _JOINTS))
            return MeshLevels.from_template(jointed, max_faces=settings.max_faces), free

        self._levels = levels

    def fit(self, first: Sight, second: Sight) -> CommonMesh | None:
        """The first camera's shape, fitted to both masks; None if the rays don't meet in front."""
        sights = first, second
        levels, settings = self._levels(first.shape.candidate)
        targets = [Target.from_crop(s.crop, plane_normal=TOWARD_CAMERA) for s in sights]
        rough = _TwoProblems(levels.coarse, settings, [t.coarse() for t in targets], self._R)
        fine = _TwoProblems(levels.fine, settings, targets, self._R)
        alone = [
            _with_joints(sight.shape.parameters, joints, levels.fine.joints)
            for sight, joints in zip(sights, self._joints, strict=True)
        ]
        depths_mm = self._depths_mm(sights, alone)
        if depths_mm is None:
            return None
        rough.place(depths_mm)
        starts = self._starts(alone, depths_mm)
        starts.sort(key=lambda x: rough.evaluate(x).loss)
        found = [rough.descend(x, _ROUGH_ITERATIONS) for x in starts[:_TRIED]]
        end = min(found, key=lambda state: state.loss)
        for n in range(_ROUNDS):
            if n > 0:
                depths_mm = self._depths_mm(sights, fine.parts(end.x))
                if depths_mm is None:
                    return None
            fine.place(depths_mm)
            if n > 0:
                fine.weigh(end.x)
            end = fine.descend(end.x, _ITERATIONS)
        points = end.pictures[0].rendering.points[levels.fine.num_vertices + 3 :]
        return CommonMesh(
            midline_mm=(points + targets[0].anchor) * depths_mm[0],
            iou=min(picture.iou for picture in end.pictures),
        )

    def _depths_mm(
        self, sights: Sequence[Sight], parts: Sequence[Float[np.ndarray, "P"]]
    ) -> Float[np.ndarray, "2"] | None:
        """Depths of the body's center in both cameras' frames; None: not in front of both."""
        first, second = (
            sight.crop.crop_camera.middle_ray()
            + np.append(np.exp(q[LOG_SIZE]) * q[ROOT_TRANSLATION], 0.0)
            + sight.drift
            for sight, q in zip(sights, parts, strict=True)
        )
        lines = np.column_stack([self._R @ first, -second])
        depths_mm = np.linalg.lstsq(lines, -self._t_mm, rcond=None)[0]
        return depths_mm if (depths_mm > 0).all() else None

    def _starts(
        self, alone: Sequence[Float[np.ndarray, "P"]], depths_mm: Float[np.ndarray, "2"]
    ) -> list[Float[np.ndarray, "X"]]:
        """Bends of either camera's fit or its mirror image, turned as any of the four is."""
        own, other = alone
        log_size = np.mean(np.array([own[LOG_SIZE], other[LOG_SIZE]]) + np.log(depths_mm))
        first, second = (own, mirror(own)), (other, mirror(other))
        turns = [q[ROOT_ROTATION] for q in first]
        turns += [_turned(self._R.T, q[ROOT_ROTATION]) for q in second]
        return [
            np.concatenate(
                [turn, own[ROOT_TRANSLATION], [log_size], q[NUM_ROOT:], other[ROOT_TRANSLATION]]
            )
            for q in (*first, *second)
            for turn in turns
        ]


def _with_joints(
    parameters: Float[np.ndarray, "P"],
    joints: Float[np.ndarray, "J 3"],
    others: Float[np.ndarray, "K 3"],
) -> Float[np.ndarray, "Q"]:
    """The parameters of about the same pose by other joints: each turns as its place does."""
    moved, known = rest_vector(len(others)), joints_of(parameters.copy())
    moved[:NUM_ROOT] = parameters[:NUM_ROOT]
    factors, to = cholesky_factors(known.weight), joints_of(moved)
    shares, slopes = np.empty(len(joints)), np.empty((len(joints), 6))
    for n, place in enumerate(others):
        skinning_weights(place, joints, factors, shares, slopes)
        to.rotation[n], to.log_scale[n] = shares @ known.rotation, shares @ known.log_scale
    return moved


def _turned(
    R: Float[np.ndarray, "3 3"], rotation: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """The rotation vector of R after another rotation."""
    return (Rotation.from_matrix(R) * Rotation.from_rotvec(rotation)).as_rotvec()


class _State(NamedTuple):
    """One iterate in both pictures."""

    x: Float[np.ndarray, "X"]
    loss: float
    pictures: Sequence[Iterate]


class _TwoProblems:
    """The loss of both pictures, by one vector of parameters.

    It has the first picture's P parameters, with the log of the size in mm, and then the second
    picture's translation.
    """

    def __init__(
        self,
        body: Body,
        settings: FitMeshSettings,
        targets: Sequence[Target],
        R: Float[np.ndarray, "3 3"],
    ) -> None:
        first, second = (
            Problem.from_settings(settings, body, target, with_smoothness=False)
            for target in targets
        )
        # The priors count once.
        lambdas = second.lambdas.copy()
        lambdas[[SCALE, TRANSLATION]] = 0.0
        nothing = second.priors._replace(tilt=0.0, joint=np.zeros_like(second.priors.joint))
        self._problems = first, second._replace(priors=nothing, lambdas=lambdas)
        self._R, self._tolerance = R, settings.tolerance
        # L_iou is a share of the mask: a fish seen on edge has less to tell, and not more.
        areas = np.array([target.mask_area for target in targets])
        self._by_area = self._weights = areas / areas.max()
        self._log_depths = np.zeros(2)

    def place(self, depths_mm: Float[np.ndarray, "2"]) -> None:
        """Set the depths of the body's center in the two cameras' frames."""
        self._log_depths = np.log(depths_mm)

    def weigh(self, x: Float[np.ndarray, "X"]) -> None:
        """Weigh the pictures by how well a pose fits them."""
        missing = np.array([1 - picture.iou for picture in self.evaluate(x).pictures])
        weights = self._by_area * np.minimum(1, _USUAL_MISSING / np.maximum(missing, 1e-9)) ** 2
        self._weights = weights / weights.max()

    def parts(
        self, x: Float[np.ndarray, "X"]
    ) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"]]:
        """The parameters in each picture."""
        first, second = x[:-2].copy(), x[:-2].copy()
        first[LOG_SIZE] -= self._log_depths[0]
        second[LOG_SIZE] -= self._log_depths[1]
        second[ROOT_ROTATION] = _turned(self._R, x[ROOT_ROTATION])
        second[ROOT_TRANSLATION] = x[-2:]
        return first, second

    def evaluate(self, x: Float[np.ndarray, "X"]) -> _State:
        pictures, loss = list[Iterate](), 0.0
        for weight, problem, q in zip(self._weights, self._problems, self.parts(x), strict=True):
            picture = evaluate(problem, q, False)
            pictures.append(picture)
            own_loss = float(picture.terms @ problem.lambdas) + prior_loss(problem, q)
            loss += weight * own_loss
        return _State(x, loss, pictures)

    def equations(self, state: _State) -> tuple[Float[np.ndarray, "X X"], Float[np.ndarray, "X"]]:
        """H and g of the quadratic model of the loss."""
        size = len(state.x)
        parts = self.parts(state.x)
        slopes = np.eye(size - 2, size), np.eye(size - 2, size)
        # R exp(w + d) = R exp(w) exp(J d): the second's rotation vector moves by J2^-1 J1 d.
        turn, other_turn = (rotation_and_jacobian(q[ROOT_ROTATION].copy())[1] for q in parts)
        slopes[1][ROOT_ROTATION, ROOT_ROTATION] = np.linalg.solve(other_turn, turn)
        slopes[1][ROOT_TRANSLATION] = np.eye(size)[-2:]
        H, g = np.zeros((size, size)), np.zeros(size)
        for n, problem in enumerate(self._problems):
            own_H, own_g = normal_equations(problem, parts[n], state.pictures[n].rendering)
            H += self._weights[n] * slopes[n].T @ own_H @ slopes[n]
            g += self._weights[n] * slopes[n].T @ own_g
        return H, g

    def descend(self, x: Float[np.ndarray, "X"], iterations: int) -> _State:
        """Levenberg-Marquardt as in `descent.minimise`."""
        damping, num_calm, num_refused = WARM_DAMPING, 0, 0
        here = self.evaluate(x)
        H, g = self.equations(here)
        for _ in range(iterations):
            step = np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-12), g)
            if g @ step / 2 < self._tolerance:
                break
            there = self.evaluate(here.x - step)
            gain = here.loss - there.loss
            if gain > 0:
                num_calm, num_refused = num_calm + 1 if gain < self._tolerance else 0, 0
                here, damping = there, damping * SHRINK
                if num_calm == 2:
                    break
                H, g = self.equations(here)
            else:
                damping, num_refused = damping * GROWTH, num_refused + 1
                if num_refused == MAX_REFUSED:
                    break
        return here
