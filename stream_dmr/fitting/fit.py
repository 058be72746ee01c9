"""One crop in, one fitted mesh out: warm from the frame before, cold where that fails."""

import time

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.camera import frame_from_crop
from stream_dmr.fitting import adam
from stream_dmr.fitting.cold_start import cold_starts
from stream_dmr.fitting.objective import Objective, Target
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.uncertainty import covariance
from stream_dmr.messages import FishCrop, FittedMesh, FittedShape, LossTerms, SolverReport
from stream_dmr.skinning import Parameters, Rig
from stream_dmr.template import Template

# Of all cold starts, this many are followed to the end.
_NUM_POLISHED = 3
# A warm start begins near the end: smaller first steps.
_WARM_STEP = 0.3
_POLISH_STEP = 0.3


class Fitter:
    """Fits one template to crops; holds nothing of any track."""

    def __init__(self, template: Template, settings: FitMeshSettings) -> None:
        self.template = template
        self.settings = settings
        self.rig = Rig.from_template(template, device=settings.device)

    def fit(self, crop: FishCrop, warm: Float[np.ndarray, "P"] | None) -> FittedMesh:
        """Fit the template to a crop's mask, starting from the parameters of the frame before.

        What can't be fitted comes back with its reason in `refusal`.
        """
        refusal = self._refusal(crop)
        if refusal:
            return _message(crop, None, None, refusal)
        began = time.perf_counter_ns()
        target = Target.from_crop(crop, device=self.settings.device)
        objective = Objective(rig=self.rig, target=target, settings=self.settings)
        solution, is_cold = self._solve(objective, crop, warm)
        if not bool(torch.isfinite(solution.loss[0])):
            return _message(crop, None, None, "fit diverged")
        shape = self._shape(objective, solution.flat[0], crop)
        report = SolverReport(
            solver=self.settings.solver,
            deformation=self.settings.deformation,
            iterations=solution.iterations,
            converged=solution.converged,
            stop_reason=solution.stop_reason,
            cold_start=is_cold,
            elapsed_ns=time.perf_counter_ns() - began,
        )
        return _message(crop, shape, report, "")

    def _refusal(self, crop: FishCrop) -> str:
        area = int(crop.mask.sum())
        if area == 0:
            return "no mask"
        return "mask too small" if area < self.settings.min_mask_px else ""

    def _solve(
        self, objective: Objective, crop: FishCrop, warm: Float[np.ndarray, "P"] | None
    ) -> tuple[adam.Solution, bool]:
        """The warm fit if it is good, else the better one of warm and cold."""
        solution = None
        if warm is not None:
            start = _recentered(objective, torch.as_tensor(warm.copy())[None])
            iterations = self.settings.warm_iterations
            solution = adam.solve(objective, start, iterations=iterations, step=_WARM_STEP)
            if float(solution.iou[0]) >= self.settings.cold_below_iou:
                return solution, False
        cold = self._solve_cold(objective, crop)
        if solution is not None and bool(solution.loss[0] <= cold.loss[0]):
            return solution, False
        return cold, True

    def _solve_cold(self, objective: Objective, crop: FishCrop) -> adam.Solution:
        """A few iterations from every start, the best ones to the end, the best of these."""
        starts = cold_starts(crop.mask, crop.crop_camera, self.template)
        starts = starts.to(self.settings.device)
        rough = adam.solve(objective, starts, iterations=self.settings.cold_iterations)
        best = rough.loss.argsort()[:_NUM_POLISHED]
        fine = adam.solve(
            objective,
            rough.flat[best],
            iterations=self.settings.polish_iterations,
            step=_POLISH_STEP,
        )
        winner = fine.loss.argmin()[None]
        return fine._replace(
            flat=fine.flat[winner],
            loss=fine.loss[winner],
            iou=fine.iou[winner],
            iterations=rough.iterations + fine.iterations,
        )

    def _shape(self, objective: Objective, flat: Float[Tensor, "P"], crop: FishCrop) -> FittedShape:
        with torch.no_grad():
            deformed = objective.deform(flat[None])
            terms = objective.terms(flat[None])
            spread, length_std = covariance(objective, flat)
            keypoints_px = objective.project(deformed.keypoints)[0]
        anchor = objective.target.anchor

        def camera_points(points: Float[Tensor, "1 N 3"]) -> Float[np.ndarray, "N 3"]:
            return (points[0] + anchor).cpu().numpy()

        return FittedShape(
            parameters=flat.cpu().numpy(),
            vertices=camera_points(deformed.vertices),
            keypoints=camera_points(deformed.keypoints),
            keypoints_px=frame_from_crop(
                keypoints_px.cpu().numpy(),
                crop_camera=crop.crop_camera,
                frame_camera=crop.frame_camera,
            ),
            midline=camera_points(deformed.midline),
            iou=float(terms.hard_iou[0]),
            losses=LossTerms(**{key: float(getattr(terms, key)[0]) for key in _LOSS_NAMES}),
            covariance=spread.cpu().numpy(),
            length_std_ratio=length_std,
        )


_LOSS_NAMES = ("iou", "boundary", "scale", "translation", "normal", "laplacian")


def _recentered(objective: Objective, flat: Float[Tensor, "1 P"]) -> Float[Tensor, "1 P"]:
    """Parameters moved sideways so that the silhouette's middle falls on the mask's."""
    flat = flat.to(objective.target.mask.device)
    rows, columns = torch.nonzero(objective.target.mask > 0.5, as_tuple=True)
    middle = torch.stack([columns, rows], dim=1).to(flat.dtype)
    middle = (middle.amin(dim=0) + middle.amax(dim=0)) / 2
    pixels = objective.project(objective.deform(flat).vertices)[0]
    gap = middle - (pixels.amin(dim=0) + pixels.amax(dim=0)) / 2
    parameters = Parameters.from_flat(flat)
    scale = parameters.root_log_scale.exp() * objective.target.K[[0, 1], [0, 1]]
    moved = parameters.root_translation + gap / scale
    return parameters._replace(root_translation=moved).flat()


def _message(
    crop: FishCrop, shape: FittedShape | None, report: SolverReport | None, refusal: str
) -> FittedMesh:
    return FittedMesh(
        frame_index=crop.frame_index,
        timestamp_ns=crop.timestamp_ns,
        track_id=crop.track_id,
        shape=shape,
        report=report,
        quality=crop.quality,
        refusal=refusal,
    )
