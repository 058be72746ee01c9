"""The paper's solver: Adam on L_rec, all parameters at once, several starts side by side."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.objective import Objective

# First steps of Adam in each kind of parameter, in its own unit (rad, body lengths, log).
_ROOT_STEPS = [0.06] * 3 + [0.01] * 2 + [0.02]
_JOINT_STEPS = [0.06] * 3 + [0.003] * 3 + [0.01] + [0.06] * 6
_DECAY = 0.97  # of the steps, per iteration: large ones find the pose, small ones the outline
_CHECK_EVERY = 10


class Solution(NamedTuple):
    """The best iterate of every start, and why the search ended."""

    flat: Float[Tensor, "B P"]
    loss: Float[Tensor, "B"]  # L_rec
    iou: Float[Tensor, "B"]  # hard
    iterations: int
    converged: bool
    stop_reason: str


def solve(
    objective: Objective, starts: Float[Tensor, "B P"], *, iterations: int, step: float = 1.0
) -> Solution:
    """Minimise L_rec from B starts (Kingma and Ba, "Adam", ICLR 2015).

    `step` scales the first steps: 1 for a cold start, less for a warm one. Stops after
    `iterations`, or once no start has fallen by more than the tolerance for ten iterations.
    """
    num_joints = (starts.shape[1] - 6) // 13
    unit = torch.tensor(_ROOT_STEPS + _JOINT_STEPS * num_joints, dtype=starts.dtype)
    unit = unit.to(starts.device) * step
    moved = torch.zeros_like(starts, requires_grad=True)
    optimizer = torch.optim.Adam([moved], lr=1.0, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, _DECAY)

    best = starts.clone()
    best_loss = torch.full_like(starts[:, 0], torch.inf)
    best_iou = torch.zeros_like(best_loss)
    last_checked = best_loss
    for iteration in range(1, iterations + 1):
        flat = starts + moved * unit
        terms = objective.terms(flat)
        loss = terms.total(objective.settings)
        is_better = loss.detach() < best_loss
        best = torch.where(is_better[:, None], flat.detach(), best)
        best_loss = torch.where(is_better, loss.detach(), best_loss)
        best_iou = torch.where(is_better, terms.hard_iou, best_iou)
        if iteration % _CHECK_EVERY == 0:
            if bool((last_checked - best_loss < objective.settings.tolerance).all()):
                return Solution(best, best_loss, best_iou, iteration, True, "L_rec settled")
            last_checked = best_loss
        optimizer.zero_grad()
        loss.sum().backward()
        optimizer.step()
        schedule.step()
    return Solution(best, best_loss, best_iou, iterations, False, "iterations used up")
