"""Damped Gauss-Newton on many contours at once: `contour/levenberg_marquardt.py` for a batch.

Each fit has its own damping and its own end. Those that have ended ride along until they are a
quarter of what runs at once; then others take their places. So the device stays busy to the last
few, and the work done is about that of the iterations needed, not of the slowest fit.
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
    which: Int[Tensor, "N"],
    starts: Float[Tensor, "N P"],
    lambdas: Float[Tensor, "6"],
    *,
    iterations: int,
    tolerance: float,
    damping: float,
    at_once: int,
) -> State:
    """Each fit's best iterate, its L_rec and hard IoU, its iterations and why it stopped.

    A fit has a start and the index of its target. Loss is infinite where the start's is not finite.
    """
    ended = _begin(starts, damping)
    index = torch.arange(min(at_once, len(starts)), device=starts.device)
    waiting = len(index)  # the first fit that has not begun
    state, seen = ended.select(index), targets.select(which[index])
    while len(index):
        step, state = _judged(state, iterations, tolerance)
        is_running = state.stop == _RUNNING
        count = int(is_running.sum())
        if 4 * count <= 3 * len(index):
            _write(ended, index, state)
            next_one = min(waiting + at_once - count, len(starts))
            new = torch.arange(waiting, next_one, device=index.device)
            waiting = next_one
            index = torch.cat([index[is_running], new])
            state, seen = ended.select(index), targets.select(which[index])
            step = torch.cat([step[is_running], torch.zeros_like(starts[new])])
        if len(index):
            state = _advanced(model, seen, state, step, lambdas, tolerance)
    return ended


def _begin(starts: Tensor, damping: float) -> State:
    """Nothing is known of the starts: the first step is none, and lowers an endless loss."""
    count, size = starts.shape
    loss = starts.new_full((count,), torch.inf)
    whole = torch.zeros(count, dtype=torch.int64, device=starts.device)
    return State(
        flat=starts.clone(),
        loss=loss,
        iou=torch.zeros_like(loss),
        H=starts.new_zeros(count, size, size),
        g=torch.zeros_like(starts),
        damping=torch.full_like(loss, damping / _SHRINK),
        calm=whole.clone(),
        refused=whole.clone(),
        iterations=whole - 1,
        stop=whole + _RUNNING,
    )


def _problem(
    model: Model, targets: Targets, flat: Tensor, lambdas: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """L_rec with the priors, hard IoU, H and g."""
    found = evaluate(model, targets, flat, lambdas)
    loss = found.terms @ lambdas + equations.prior_loss(model, targets, flat)
    return loss, found.iou, *normal_equations(model, targets, flat, lambdas, found)


def _judged(state: State, iterations: int, tolerance: float) -> tuple[Tensor, State]:
    """The steps (H + damping diag H)^-1 g, and an end to fits that gain too little by theirs.

    Where H has no factor there is no step, and it is refused, so that damping grows.
    """
    damped = state.H.clone()
    diagonal = damped.diagonal(dim1=1, dim2=2)
    diagonal += state.damping[:, None] * diagonal + 1e-12
    factor, info = torch.linalg.cholesky_ex(damped)
    step = torch.cholesky_solve(state.g[..., None], factor)[..., 0]
    is_found = (info == 0) & torch.isfinite(step).all(dim=1)
    step = torch.where(is_found[:, None], step, 0.0)
    promise = 0.5 * (state.g * step).sum(dim=1)
    is_small = is_found & torch.isfinite(state.loss) & (promise < tolerance)
    state = _stopped(state, state.iterations == iterations, EXHAUSTED)
    return step, _stopped(state, is_small, SETTLED)


def _advanced(
    model: Model,
    targets: Targets,
    state: State,
    step: Tensor,
    lambdas: Tensor,
    tolerance: float,
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
        state.iterations + is_running,
        state.stop,
    )
    state = _stopped(state, state.calm == 2, SETTLED)
    return _stopped(state, state.refused == _MOST_REFUSED, STUCK)


def _stopped(state: State, is_over: Bool[Tensor, "B"], reason: int) -> State:
    is_over = is_over & (state.stop == _RUNNING)
    return state._replace(stop=torch.where(is_over, reason, state.stop))


def _write(all_fits: State, index: Int[Tensor, "K"], some: State) -> None:
    """Bring some of the fits up to date, in place."""
    for old, new in zip(all_fits, some, strict=True):
        old.index_copy_(0, index, new)
