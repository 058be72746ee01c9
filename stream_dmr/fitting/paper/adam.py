"""The paper's solver in torch: the reconstruction loss, eq. (3)-(5) of Sec. 2.2, and Adam.

Every term of the loss takes B fits at once and returns B numbers, before its lambda.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.errors import ConfigError
from stream_dmr.fitting.body import NUM_PER_JOINT, NUM_ROOT
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.paper.torch_body import (
    DEFORMATIONS,
    Parameters,
    Rig,
    deform,
    project,
    silhouette,
)
from stream_dmr.fitting.target import Solution, Target, rank
from stream_dmr.template.template import Template


def iou_loss(
    silhouettes: Float[Tensor, "B S S"], target: Float[Tensor, "S S"]
) -> Float[Tensor, "B"]:
    """L_iou = 1 - |A and B| / |A or B| of eq. (3), with covered shares for set membership."""
    both = (silhouettes * target).sum(dim=(1, 2))
    either = silhouettes.sum(dim=(1, 2)) + target.sum() - both
    return 1.0 - both / either.clamp(min=1e-9)


def boundary_loss(
    silhouettes: Float[Tensor, "B S S"], signed_distance: Float[Tensor, "S S"]
) -> Float[Tensor, "B"]:
    """L_boundary: mean over the pixels of silhouette times signed distance to the target's edge.

    Kervadec et al., "Boundary loss for highly unbalanced segmentation", MIDL 2019, eq. (5). The
    distance is in percent of the picture's side, so that the term doesn't depend on its resolution.
    """
    percent = signed_distance * (100.0 / signed_distance.shape[0])
    return (silhouettes * percent).mean(dim=(1, 2))


def scale_loss(joint_log_scales: Float[Tensor, "B J"]) -> Float[Tensor, "B"]:
    """L_s = sum_j (S_j - 1)^2 of eq. (4)."""
    return (joint_log_scales.exp() - 1.0).square().sum(dim=1)


def translation_loss(joint_translations: Float[Tensor, "B J 3"]) -> Float[Tensor, "B"]:
    """L_t = sum_j |T_j|^2 of eq. (4), in body lengths."""
    return joint_translations.square().sum(dim=(1, 2))


def normal_loss(vertices: Float[Tensor, "B V 3"], rig: Rig) -> Float[Tensor, "B"]:
    """L_normal = sum over neighbouring faces of 1 - cos(n_i, n_j), eq. (5)."""
    a, b, c = vertices[:, rig.faces].unbind(dim=2)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-12)
    first, second = normals[:, rig.edge_faces].unbind(dim=2)
    return (1.0 - (first * second).sum(dim=-1)).sum(dim=1)


def laplacian_loss(vertices: Float[Tensor, "B V 3"], rig: Rig) -> Float[Tensor, "B"]:
    """L_lap = sum_i |V_i - mean of its neighbours|^2, eq. (5), in body lengths."""
    first, second = rig.edges.unbind(dim=1)
    sums = torch.zeros_like(vertices)
    sums = sums.index_add(1, first, vertices[:, second]).index_add(1, second, vertices[:, first])
    return (vertices - sums / rig.num_neighbors[:, None]).square().sum(dim=(1, 2))


class Terms(NamedTuple):
    """The terms of eq. (3) for a batch of fits before their lambdas, (B, 6), and the hard IoU."""

    terms: Float[Tensor, "B 6"]  # iou, boundary, scale, translation, normal, laplacian
    iou: Float[Tensor, "B"]


class Objective:
    """L_rec of a batch of deformations of one rig against one target."""

    def __init__(self, rig: Rig, target: Target, settings: FitMeshSettings) -> None:
        def tensor(array: object) -> Tensor:
            return torch.as_tensor(array, device=settings.device)

        self.lambdas = tensor(settings.lambdas())
        self._rig = rig
        self._deformation = DEFORMATIONS[settings.deformation]
        self._K, self._anchor = tensor(target.K), tensor(target.anchor)
        self._mask, self._distance = tensor(target.mask), tensor(target.distance)
        self._known = tensor(~target.unknown) if len(target.unknown) else 1.0

    def terms(self, vector: Float[Tensor, "B P"]) -> Terms:
        """Each term of eq. (3); the shape terms are taken in body lengths."""
        parameters = Parameters.from_vector(vector)
        vertices = deform(self._rig, vector, self._deformation).vertices
        pixels = project(vertices + self._anchor, self._K)
        covered = silhouette(pixels, self._rig, size=self._mask.shape[0]) * self._known
        shape = vertices / parameters.root_log_scale.exp()[:, None, None]
        terms = (
            iou_loss(covered, self._mask),
            boundary_loss(covered, self._distance),
            scale_loss(parameters.joint_log_scales),
            translation_loss(parameters.joint_translations),
            normal_loss(shape, self._rig),
            laplacian_loss(shape, self._rig),
        )
        hard = (covered.detach() >= 0.5).to(covered.dtype)
        return Terms(torch.stack(terms, dim=1), 1.0 - iou_loss(hard, self._mask))


# First steps of Adam in each kind of parameter, in its own unit (rad, body lengths, log).
ROOT_STEPS = [0.06] * 3 + [0.01] * 2 + [0.02]
JOINT_STEPS = [0.06] * 3 + [0.003] * 3 + [0.01] + [0.06] * 6
STEP_DECAY = 0.97  # of the steps, per iteration: large steps find the pose, small ones the outline
# Iterations between two checks for an end; of every start in a search; starts that are finished.
# All numbers of the descent were chosen by trial: the paper gives none.
_CHECK_EVERY = 10
_SEARCH_ITERATIONS = 40
_NUM_FINISHED = 3
# First steps, relative to the steps above: near the answer they are smaller.
NEAR, FAR = 0.3, 1.0


class AdamSolver:
    """Gradient descent on the differentiable silhouette (Kingma and Ba, "Adam", ICLR 2015)."""

    def __init__(self, template: Template, settings: FitMeshSettings) -> None:
        """Raises ConfigError if the settings name a device that is not there."""
        if settings.device == "cuda" and not torch.cuda.is_available():
            raise ConfigError(
                "[fit_mesh]: expected a CUDA device and a CUDA build of torch for "
                'device = "cuda", found none; set device = "cpu"'
            )
        # Tensors this small gain nothing from threads, and wait for them if cores are busy.
        torch.set_num_threads(1)
        self._rig = Rig.from_template(template, device=settings.device)
        self._settings = settings

    def refine(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        return self.descend(target, start[None], self._settings.adam_iterations, NEAR)[0]

    def search(self, target: Target, starts: Float[np.ndarray, "B P"]) -> Solution:
        """A few iterations from every start, the best few to the end, the best of these."""
        rough = self.descend(target, starts, _SEARCH_ITERATIONS, FAR)
        rough.sort(key=lambda solution: rank(target, solution))
        best = np.stack([solution.parameters for solution in rough[:_NUM_FINISHED]])
        fine = self.descend(target, best, self._settings.adam_iterations, NEAR)
        return min(fine, key=lambda solution: rank(target, solution))

    def descend(
        self, target: Target, starts: Float[np.ndarray, "B P"], iterations: int, step: float
    ) -> list[Solution]:
        """Minimise L_rec from B starts at once.

        Stops after `iterations`, or once no start has fallen by more than the tolerance for ten.
        """
        objective = Objective(self._rig, target, self._settings)
        origin = torch.tensor(starts, device=self._settings.device)
        num_joints = (starts.shape[1] - NUM_ROOT) // NUM_PER_JOINT
        unit = torch.tensor(ROOT_STEPS + JOINT_STEPS * num_joints, dtype=origin.dtype)
        unit = unit.to(origin.device) * step
        moved = torch.zeros_like(origin, requires_grad=True)
        optimizer = torch.optim.Adam([moved], lr=1.0, betas=(0.8, 0.95))
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, STEP_DECAY)
        best = _Best(origin)
        last_checked = best.loss
        for iteration in range(1, iterations + 1):
            parameters = origin + moved * unit
            terms, iou = objective.terms(parameters)
            loss = terms @ objective.lambdas
            best.update(parameters.detach(), loss.detach(), iou)
            if iteration % _CHECK_EVERY == 0:
                if bool((last_checked - best.loss < self._settings.tolerance).all()):
                    return best.solutions(iteration, True, "L_rec settled")
                last_checked = best.loss
            optimizer.zero_grad()
            loss.sum().backward()
            optimizer.step()
            schedule.step()
        return best.solutions(iterations, False, "iterations used up")


class _Best:
    """The best iterate so far of each start."""

    def __init__(self, starts: Float[Tensor, "B P"]) -> None:
        self.parameters = starts
        self.loss = torch.full_like(starts[:, 0], torch.inf)
        self._iou = torch.zeros_like(self.loss)

    def update(
        self, parameters: Float[Tensor, "B P"], loss: Float[Tensor, "B"], iou: Float[Tensor, "B"]
    ) -> None:
        is_better = loss < self.loss
        self.parameters = torch.where(is_better[:, None], parameters, self.parameters)
        self.loss = torch.where(is_better, loss, self.loss)
        self._iou = torch.where(is_better, iou, self._iou)

    def solutions(self, iterations: int, converged: bool, stop_reason: str) -> list[Solution]:
        columns = self.parameters.cpu().numpy(), self.loss.tolist(), self._iou.tolist()
        return [
            Solution(*row, iterations, converged, stop_reason) for row in zip(*columns, strict=True)
        ]
