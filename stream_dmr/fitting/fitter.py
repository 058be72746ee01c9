"""Fit one mesh to one crop: warm from the frame before, else cold; then find the expected size."""

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from stream_dmr.camera import frame_from_crop
from stream_dmr.errors import requires_extra
from stream_dmr.fitting.body import LOG_SIZE, ROOT_ROTATION, Body, MeshLevels
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.heading import is_reversed
from stream_dmr.fitting.shape.candidates import CandidateShape
from stream_dmr.fitting.shape.space import (
    TRUNK,
    directions,
    half_section,
    individual_covariance,
    reshaped,
    std_of,
)
from stream_dmr.fitting.size import SizeScanner, nats_against
from stream_dmr.fitting.solver.contour_solver import ContourSolver
from stream_dmr.fitting.solver.descent import evaluate
from stream_dmr.fitting.solver.outline import COVERED, project
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.starts import cold_starts, recentered
from stream_dmr.fitting.target import TOWARD_CAMERA, Solution, Solver, Target
from stream_dmr.fitting.uncertainty import (
    covariance,
    freed,
    length_std_ratio,
    shape_std_ratio,
    slant_std_ratio,
)
from stream_dmr.geometry import arc_length
from stream_dmr.messages import FishCrop, FittedMesh, FittedShape, LossTerms, SolverReport
from stream_dmr.reasons import Reason
from stream_dmr.template.template import Template

# L_rec that a cold fit must gain to replace the pose of the frame before, and with it the end at
# which the head is. Chosen by trial.
_CLEAR_GAIN = 0.01
# The rounded tail of a flounder ends behind a mesh whose tail is straight or forked. How far a
# still's mask goes on behind the mesh, over the length: the tail moves on by so much from the first
# to the second, from where on it is something else; and the std of the length over that way. Films'
# masks are too coarse. Chosen on photographs; see docs/research/real-pictures.md.
_MIN_TAIL_GAP, _MAX_TAIL_GAP, _TAIL_GAP_STD = 0.025, 0.08, 0.5
_LAST_PART = 0.75  # of the midline's points: from there on it shows where the tail points
_RAY_STEP_PX = 0.25


class Solved(NamedTuple):
    """The likeliest fit of one crop, or the reason why there is none."""

    target: Target | None
    solution: Solution | None
    is_cold: bool
    refusal: Reason | None
    since_ns: int


class Fit(NamedTuple):
    """The result of one crop."""

    mesh: FittedMesh
    best: Float[np.ndarray, "P"] | None  # the likeliest parameters: start of the next frame


class Fitter:
    """Fits one template to crops; keeps no state of any track."""

    def __init__(
        self,
        template: Template,
        settings: FitMeshSettings,
        *,
        index: int | None = None,
        candidate: CandidateShape | None = None,
        plane_normal: Float[np.ndarray, "3"] | None = None,
        with_covariance: bool = False,
    ) -> None:
        """`plane_normal`, in the camera frame, is of the plane that fish hang in; None: facing it.

        A `candidate` gives the template its shape, with a breadth as free as it is unknown; its
        `index` is kept in the fits. `with_covariance`: fits contain the parameters' covariance.
        """
        normal = TOWARD_CAMERA if plane_normal is None else plane_normal
        self._index = index
        self._shape_covariance = individual_covariance()
        self._breadth_std = 0.0  # of the log breadth, if it is learnt
        if candidate is not None:
            template = reshaped(template, candidate.coefficients)
            settings = freed(settings, std_of(TRUNK, candidate.covariance) ** 2)
            self._shape_covariance += candidate.covariance
            if candidate.covariance.any():
                self._breadth_std = std_of(TRUNK, self._shape_covariance)
        self.plane_normal = np.ascontiguousarray(normal)
        self._template = template
        self._settings = settings
        self._with_covariance = with_covariance
        self._levels = MeshLevels.from_template(template, max_faces=settings.max_faces)
        self._solver = self._make_solver()
        self._scanner = SizeScanner(self._levels, settings)
        self._half_section = half_section(template)
        self._directions = directions(self._levels.coarse)

    def _make_solver(self) -> Solver:
        if self._settings.solver == "contour":
            return ContourSolver(self._levels, self._settings)
        with requires_extra("torch", '[fit_mesh] solver = "adam"'):  # it takes a second to import
            from stream_dmr.fitting.paper.adam import AdamSolver

        return AdamSolver(self._template, self._settings)

    def target(self, crop: FishCrop) -> Target:
        return Target.from_crop(crop, plane_normal=self.plane_normal)

    def fit(self, crop: FishCrop, warm: Float[np.ndarray, "P"] | None) -> Fit:
        """Fit the template to a crop's mask, starting from `best` of the frame before.

        A crop that can't be fitted comes back with the reason in `refusal`.
        """
        return self.answer(crop, self.solve(crop, warm))

    def solve(self, crop: FishCrop, warm: Float[np.ndarray, "P"] | None) -> Solved:
        """The first half of `fit`: the likeliest pose."""
        refusal, began = self._refusal(crop), time.perf_counter_ns()
        if refusal:
            return Solved(None, None, False, refusal, began)
        target = self.target(crop)
        solution, is_cold = self._solve(target, warm)
        return Solved(target, solution, is_cold, None, began)

    def nats(self, solved: Solved) -> float:
        """Negative log likelihood of a mask, to compare shapes; NaN if it can't be computed."""
        if solved.target is None or solved.solution is None or not _is_finite(solved.solution):
            return float("nan")
        problem = Problem.from_settings(
            self._settings, self._levels.fine, solved.target, with_smoothness=False
        )
        return nats_against(problem, solved.solution.parameters, nat=self._settings.nat)

    def log_size(self, solved: Solved) -> float:
        """The log size of the likeliest pose; NaN: nothing was fitted."""
        if solved.solution is None:
            return float("nan")
        return float(solved.solution.parameters[LOG_SIZE])

    def answer(self, crop: FishCrop, solved: Solved, *, form_std_ratio: float = 0.0) -> Fit:
        """The second half: the message, at the size that is to be expected of the fish.

        `form_std_ratio`: std of its log length, since it may be of another candidate's shape.
        """
        target, solution, is_cold, refusal, since_ns = solved
        if target is None or solution is None:
            return Fit(_message(crop, refusal=refusal), None)
        if not _is_finite(solution):
            return Fit(_message(crop, refusal=Reason.FIT_DIVERGED), None)
        sized, size_std, shape_std = solution, None, None
        if self._settings.scans_sizes:  # the paper's solver and blend scan no sizes
            coarse = target.coarse()
            sized, size_std = self._scanner.expected(target, solution, coarse=coarse)
            if not _is_finite(sized):
                return Fit(_message(crop, refusal=Reason.FIT_DIVERGED), None)
            own_std = shape_std_ratio(
                self._problem(self._levels.coarse, coarse),
                sized.parameters,
                self._directions,
                self._shape_covariance,
            )
            slant_std = self._hidden_slant_std(sized.parameters)
            shape_std = float(np.hypot(np.hypot(own_std, slant_std), form_std_ratio))
        shape = self._shape(target, sized, crop, size_std, shape_std)
        report = SolverReport(
            solver=self._settings.solver,
            deformation=self._settings.deformation,
            iterations=solution.iterations,
            converged=solution.converged,
            stop_reason=solution.stop_reason,
            cold_start=is_cold,
            elapsed_ns=time.perf_counter_ns() - since_ns,
        )
        return Fit(_message(crop, shape, report), solution.parameters)

    def _refusal(self, crop: FishCrop) -> Reason | None:
        area = np.count_nonzero(crop.mask)
        if area == 0:
            return Reason.NO_MASK
        if area == crop.mask.size:
            return Reason.MASK_FILLS_CROP
        return Reason.MASK_TOO_SMALL if area < self._settings.min_mask_px else None

    def _solve(self, target: Target, warm: Float[np.ndarray, "P"] | None) -> tuple[Solution, bool]:
        """The warm fit if it is good, else a cold fit if that is clearly better.

        A warm start with its head at the wrong end is not tried.
        """
        solution = None
        if warm is not None and not is_reversed(warm, target.heading):
            start = recentered(self._problem(self._levels.fine, target), warm)
            solution = self._solver.refine(target, start)
            if solution.iou >= self._settings.cold_below_iou:
                return solution, False
        cold = self._solver.search(target, cold_starts(target, self._template))
        if solution is not None and solution.loss < cold.loss + _CLEAR_GAIN:
            return solution, False
        return cold, True

    def _shape(
        self,
        target: Target,
        solution: Solution,
        crop: FishCrop,
        size_std: float | None,
        shape_std: float | None,
    ) -> FittedShape:
        """`size_std` of the log size, if it is known better than by the covariance."""
        parameters, v = solution.parameters, self._levels.full.num_vertices
        problem = self._problem(self._levels.full, target)
        terms, iou, rendering = evaluate(problem, parameters, True)
        points, spread = rendering.points, None
        if size_std is None or self._with_covariance:
            spread = covariance(problem, self._settings, parameters, rendering)
            if size_std is None:
                size_std = length_std_ratio(problem, parameters, points, spread)
        if crop.quality.length_doubt is not None:  # only stills have one
            midline = points[v + 3 :]
            midline_px = project(midline, target.anchor, target.K)
            of_mask, of_mesh = (
                beyond_tail(shown, midline_px) for shown in (crop.mask, rendering.covered > COVERED)
            )
            beyond = max(of_mask - of_mesh, 0.0)
            size_std = float(np.hypot(size_std, _TAIL_GAP_STD * beyond))
            if _MIN_TAIL_GAP < beyond < _MAX_TAIL_GAP:
                points = points.copy()
                points[[v + 2, -1]] += beyond * arc_length(midline) * _end_direction(midline)
        placed = points + target.anchor
        keypoints_px = project(points[v : v + 3], target.anchor, target.K)
        return FittedShape(
            parameters=parameters,
            vertices=placed[:v],
            keypoints=placed[v : v + 3],
            keypoints_px=frame_from_crop(
                keypoints_px, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera
            ),
            midline=placed[v + 3 :],
            iou=iou,
            losses=LossTerms(**dict(zip(LossTerms.__slots__, terms.tolist(), strict=True))),
            covariance=spread if self._with_covariance else None,
            length_std_ratio=size_std,
            candidate=self._index,
            shape_std_ratio=shape_std,
            height_ratio=self._reach(parameters, self.plane_normal),
        )

    def _hidden_slant_std(self, parameters: Float[np.ndarray, "P"]) -> float:
        """Std of the log length by a slant that an uncertain breadth may hide.

        A fish that shows its broad side rather rolls than slants, so this counts as far as it can't
        roll: by the least breadth of its section over the breadth that it shows.
        """
        if self._breadth_std == 0.0:
            return 0.0
        R = Rotation.from_rotvec(parameters[ROOT_ROTATION]).as_matrix()
        across = np.cross(self.plane_normal, R[:, 0])
        across /= max(float(np.linalg.norm(across)), 1e-9)
        shown = self._reach(parameters, across)
        roundness = min(float(self._half_section.min()) / max(shown, 1e-9), 1.0)
        return roundness * slant_std_ratio(
            float(np.arcsin(np.clip(self.plane_normal @ R[:, 0], -1, 1))),
            slant_std_rad=self._settings.tilt_std_rad,
            breadth_std=self._breadth_std,
        )

    def _reach(
        self, parameters: Float[np.ndarray, "P"], direction: Float[np.ndarray, "3"]
    ) -> float:
        """How far the elliptic section at the center of a body reaches in a direction."""
        R = Rotation.from_rotvec(parameters[ROOT_ROTATION]).as_matrix()
        return float(np.linalg.norm(self._half_section * (direction @ R)[1:]))

    def _problem(self, body: Body, target: Target) -> Problem:
        return Problem.from_settings(self._settings, body, target, with_smoothness=True)


def beyond_tail(mask: Bool[np.ndarray, "S S"], midline_px: Float[np.ndarray, "M 2"]) -> float:
    """How far a mask goes on beyond the tail, straight on, over the body's length; at most 1."""
    length_px = arc_length(midline_px)
    if not np.isfinite(length_px):
        return 0.0
    steps_px = np.arange(0, min(length_px, 2 * len(mask)), _RAY_STEP_PX)[:, None]
    columns, rows = np.round(midline_px[-1] + steps_px * _end_direction(midline_px)).astype(int).T
    inside = (rows >= 0) & (rows < len(mask)) & (columns >= 0) & (columns < len(mask))
    inside[inside] = mask[rows[inside], columns[inside]]
    end = len(inside) if inside.all() else int(np.argmin(inside))
    return min(end * _RAY_STEP_PX / max(length_px, _RAY_STEP_PX), 1.0)


def _end_direction(midline: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "D"]:
    """Where a midline points at the tail, of length 1."""
    along = midline[-1] - midline[int(_LAST_PART * len(midline))]
    return along / max(float(np.linalg.norm(along)), 1e-9)


def _is_finite(solution: Solution) -> bool:
    return bool(np.isfinite(solution.parameters).all() and np.isfinite(solution.loss))


def _message(
    crop: FishCrop,
    shape: FittedShape | None = None,
    report: SolverReport | None = None,
    *,
    refusal: Reason | None = None,
) -> FittedMesh:
    return FittedMesh(
        frame_index=crop.frame_index,
        timestamp_ns=crop.timestamp_ns,
        track_id=crop.track_id,
        shape=shape,
        report=report,
        quality=crop.quality,
        refusal=refusal or "",
        species=crop.species,
    )
