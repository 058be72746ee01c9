"""Damped Gauss-Newton on many contours at once: `contour/levenberg_marquardt.py` for a batch.

Each fit has its own damping and its own end. Those that have ended ride along until they are a
quarter of the batch; then the rest is packed together, so that the work done is about that of the
iterations needed, not of the slowest fit.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stream_dmr.fitting.batched import normal_equations as equations
from stream_dmr.fitting.batched.deformation import Body, deform
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.outline import Rim, coverage, overlap, project, rim_edges
from stream_dmr.fitting.batched.smoothness import Smoothness, smoothness
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.contour.levenberg_marquardt import (
    _GROWTH,
    _MOST_REFUSED,
    _SHRINK,
    EXHAUSTED,
    SETTLED,
    STUCK,
)

_RUNNING = -1


class Evaluation(NamedTuple):
    """The terms of eq. (3) and the hard IoU, with what the normal equations need again."""

    terms: Float[Tensor, "B 6"]
    iou: Float[Tensor, "B"]
    body: Body
    smooth: Smoothness
    pixels: Float[Tensor, "B V 2"]
    rim: Rim
    covered: Float[Tensor, "B S S"]


class State(NamedTuple):
    """Where each fit stands; rows of H and g belong to `flat`."""

    flat: Float[Tensor, "B P"]
    loss: Float[Tensor, "B"]
    iou: Float[Tensor, "B"]
    H: Float[Tensor, "B P P"]
    g: Float[Tensor, "B P"]
    damping: Float[Tensor, "B"]
    calm: Int[Tensor, "B"]  # small gains in a row
    refused: Int[Tensor, "B"]  # steps refused in a row
    iterations: Int[Tensor, "B"]
    stop: Int[Tensor, "B"]

    def select(self, index: Tensor) -> "State":
        """Some of the fits."""
        return State(*(part[index] for part in self))


def evaluate(
    model: Model, targets: Targets, flat: Float[Tensor, "B P"], lambdas: Float[Tensor, "6"]
) -> Evaluation:
    """One iterate of each fit; the lambdas only weight the slopes of `smooth`."""
    body = deform(model, flat)
    vertices = body.points[:, : model.num_vertices]
    pixels = project(vertices, targets)
    rim = rim_edges(pixels, model)
    covered = coverage(pixels, rim, targets.mask.shape[1])
    iou, boundary, hard = overlap(covered, targets)
    smooth = smoothness(model, vertices, flat[:, 5].exp(), lambdas)
    joints = model.joint_values(flat)
    scale = (joints[..., 6].exp() - 1.0).square().sum(dim=1)
    translation = joints[..., 3:6].square().sum(dim=(1, 2))
    terms = [iou, boundary, scale, translation, smooth.normal, smooth.laplacian]
    return Evaluation(torch.stack(terms, dim=1), hard, body, smooth, pixels, rim, covered)


def normal_equations(
    model: Model,
    targets: Targets,
    flat: Float[Tensor, "B P"],
    lambdas: Float[Tensor, "6"],
    found: Evaluation,
) -> tuple[Float[Tensor, "B P P"], Float[Tensor, "B P"]]:
    """H and g of the quadratic model E(flat + x) = E + g x + x H x / 2."""
    seen = equations.visible_rim(found.pixels, found.rim, found.covered)
    rows = equations.joined(
        equations.rim_rows(targets, seen), equations.contour_rows(targets, seen)
    )
    chosen, index = equations.rim_vertices(seen.rim, model.num_vertices)
    slopes = found.body.slopes()
    points = found.body.points.gather(1, chosen[..., None].expand(-1, -1, 3))
    H, g = equations.weighted_squares(
        rows, index, equations.pixel_slopes(points, slopes.at(chosen), targets)
    )
    held, pulled = equations.regularisers(model, targets, flat, lambdas)
    g = g + pulled + slopes.pull_back(found.smooth.forces)
    g[:, 5] += found.smooth.size_slope
    return H + held, g


def minimise(
    model: Model,
    targets: Targets,
    starts: Float[Tensor, "B P"],
    lambdas: Float[Tensor, "6"],
    *,
    iterations: int,
    tolerance: float,
    damping: float,
) -> State:
    """Each fit's best iterate, its L_rec and hard IoU, its iterations and why it stopped."""
    ended = state = _begin(model, targets, starts, lambdas, damping)
    which = torch.arange(len(starts), device=starts.device)
    for iteration in range(1, iterations + 1):
        step, predicted = _steps(state)
        is_over = (state.stop == _RUNNING) & (predicted < tolerance)
        state = _stopped(state, is_over, SETTLED, iteration - 1)
        is_running = state.stop == _RUNNING
        count = int(is_running.sum())
        if count == 0:
            break
        if 4 * count <= 3 * len(which):
            ended = _written(ended, which, state)
            index = torch.nonzero(is_running)[:, 0]
            state, targets = state.select(index), targets.select(index)
            which, step = which[index], step[index]
        state = _advanced(model, targets, state, step, lambdas, tolerance, iteration)
    state = _stopped(state, state.stop == _RUNNING, EXHAUSTED, iterations)
    return _written(ended, which, state)


def _begin(model: Model, targets: Targets, flat: Tensor, lambdas: Tensor, damping: float) -> State:
    loss, iou, H, g = _problem(model, targets, flat, lambdas)
    count = torch.zeros(len(flat), dtype=torch.int64, device=flat.device)
    return State(
        flat, loss, iou, H, g, torch.full_like(loss, damping), count, count, count, count + _RUNNING
    )


def _problem(
    model: Model, targets: Targets, flat: Tensor, lambdas: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """L_rec with the priors, hard IoU, H and g."""
    found = evaluate(model, targets, flat, lambdas)
    loss = found.terms @ lambdas + equations.prior_loss(model, targets, flat)
    return loss, found.iou, *normal_equations(model, targets, flat, lambdas, found)


def _steps(state: State) -> tuple[Tensor, Tensor]:
    """(H + damping diag H)^-1 g, and the gain that this promises.

    Where H has no factor the step is none and the promise endless, so that damping grows.
    """
    damped = state.H.clone()
    diagonal = damped.diagonal(dim1=1, dim2=2)
    diagonal += state.damping[:, None] * diagonal + 1e-12
    factor, info = torch.linalg.cholesky_ex(damped)
    step = torch.cholesky_solve(state.g[..., None], factor)[..., 0]
    is_found = (info == 0) & torch.isfinite(step).all(dim=1)
    step = torch.where(is_found[:, None], step, 0.0)
    promise = 0.5 * (state.g * step).sum(dim=1)
    return step, torch.where(is_found, promise, torch.inf)


def _advanced(
    model: Model,
    targets: Targets,
    state: State,
    step: Tensor,
    lambdas: Tensor,
    tolerance: float,
    iteration: int,
) -> State:
    """Every fit that runs tries its step; what raises its loss is refused."""
    trial = state.flat - step
    found = (trial, *_problem(model, targets, trial, lambdas))
    is_running = state.stop == _RUNNING
    gain = state.loss - found[1]
    is_better = is_running & (gain > 0)
    flat, loss, iou, H, g = (
        torch.where(is_better.view(-1, *[1] * (new.dim() - 1)), new, old)
        for new, old in zip(found, state, strict=False)
    )
    is_calm = is_better & (gain < tolerance)
    state = State(
        flat,
        loss,
        iou,
        H,
        g,
        state.damping * torch.where(is_better, _SHRINK, _GROWTH).to(loss.dtype),
        torch.where(is_better, (state.calm + 1) * is_calm, state.calm),
        (state.refused + 1) * ~is_better,
        state.iterations,
        state.stop,
    )
    state = _stopped(state, is_better & (state.calm == 2), SETTLED, iteration)
    return _stopped(state, is_running & (state.refused == _MOST_REFUSED), STUCK, iteration)


def _stopped(state: State, is_over: Bool[Tensor, "B"], reason: int, iterations: int) -> State:
    return state._replace(
        stop=torch.where(is_over, reason, state.stop),
        iterations=torch.where(is_over, iterations, state.iterations),
    )


def _written(all_fits: State, which: Int[Tensor, "K"], some: State) -> State:
    """The fits `which` among all of them brought up to date."""
    return State(*(old.index_copy(0, which, new) for old, new in zip(all_fits, some, strict=True)))
