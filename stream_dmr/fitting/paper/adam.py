"""The paper's solver: Adam on L_rec, all parameters at once, several starts side by side."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.errors import ConfigError
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.paper.objective import Objective
from stream_dmr.fitting.paper.skinning import Rig
from stream_dmr.fitting.parameters import NUM_PER_JOINT, NUM_ROOT
from stream_dmr.fitting.solver import Solution, rank
from stream_dmr.fitting.target import Target
from stream_dmr.template.template import Template

# First steps of Adam in each kind of parameter, in its own unit (rad, body lengths, log).
ROOT_STEPS = [0.06] * 3 + [0.01] * 2 + [0.02]
JOINT_STEPS = [0.06] * 3 + [0.003] * 3 + [0.01] + [0.06] * 6
STEP_DECAY = 0.97  # of the steps, per iteration: large ones find the pose, small ones the outline
# Iterations between two checks for an end; of every start in a search; starts that are finished.
# All numbers of the descent were chosen by trial: the paper gives none.
_CHECK_EVERY = 10
_SEARCH_ITERATIONS = 40
_NUM_FINISHED = 3
# First steps, relative to those above: near the answer they are smaller.
NEAR, FAR = 0.3, 1.0


class AdamSolver:
    """Gradient descent on the differentiable silhouette (Kingma and Ba, "Adam", ICLR 2015)."""

    def __init__(self, template: Template, settings: FitMeshSettings) -> None:
        """Raises ConfigError where the settings name a device that is not there."""
        if settings.device == "cuda" and not torch.cuda.is_available():
            raise ConfigError(
                "[fit_mesh]: expected a CUDA device and a CUDA build of torch for "
                'device = "cuda", found none; set device = "cpu"'
            )
        # Tensors this small gain nothing from threads, and wait for them where cores are busy.
        torch.set_num_threads(1)
        self._rig = Rig.from_template(template, device=settings.device)
        self._settings = settings

    def refine(self, target: Target, start: Float[np.ndarray, "P"]) -> Solution:
        """From one start near the answer."""
        return self.descend(target, start[None], self._settings.adam_iterations, NEAR)[0]

    def search(self, target: Target, starts: Float[np.ndarray, "B P"]) -> Solution:
        """A few iterations from every start, the best ones to the end, the best of these."""
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
