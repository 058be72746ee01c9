"""The least-squares problems of one iterate of each fit.

Residuals, weights and regularisers are those of `contour/normal_equations.py`, where they are
explained.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stream_dmr.body import JOINT, ROOT
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.outline import Rim, ends, packed
from stream_dmr.fitting.batched.rotation import rotation, turn_slope
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.contour.normal_equations import _FLAT_PX, _GAUGE, _SAME_WAY


class Visible(NamedTuple):
    """Rim edges with nothing of the body outside them."""

    rim: Rim
    start: Float[Tensor, "B R 2"]
    way: Float[Tensor, "B R 2"]
    normals: Float[Tensor, "B R 2"]  # outward
    lengths: Float[Tensor, "B R"]  # 0 where an edge is not real


class Rows(NamedTuple):
    """Residuals at places between two vertices, and where moving these takes them."""

    first: Int[Tensor, "B N"]
    second: Int[Tensor, "B N"]
    place: Float[Tensor, "B N"]  # 0 at the first vertex, 1 at the second
    way: Float[Tensor, "B N 2"]  # the direction in the picture that the residual measures
    residuals: Float[Tensor, "B N"]
    weights: Float[Tensor, "B N"]


def visible_rim(
    pixels: Float[Tensor, "B V 2"], rim: Rim, covered: Float[Tensor, "B S S"]
) -> Visible:
    """The part of the rim that is seen against the background."""
    start, end = ends(pixels, rim)
    way = end - start
    lengths = way.norm(dim=2)
    normals = torch.stack([way[..., 1], -way[..., 0]], dim=2) / lengths[..., None].clamp(min=1e-9)
    column, row = torch.round((start + end) / 2 + normals).long().unbind(dim=2)
    size = covered.shape[1]
    is_in = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    cell = (row * size + column).clamp(0, size * size - 1)
    is_hidden = is_in & (covered.flatten(1).gather(1, cell) >= 0.5)
    index, is_real = packed(rim.is_real & ~is_hidden & (lengths >= 1e-9))

    def kept(values: Tensor) -> Tensor:
        return values[torch.arange(len(index), device=index.device)[:, None], index]

    edges = Rim(kept(rim.start), kept(rim.end), is_real)
    return Visible(edges, kept(start), kept(way), kept(normals), kept(lengths) * is_real)


def rim_vertices(rim: Rim, num_vertices: int) -> tuple[Int[Tensor, "B C"], Int[Tensor, "B V"]]:
    """The vertices of rim edges, each once, and where each is among them."""
    is_chosen = torch.zeros(
        len(rim.start), num_vertices + 1, dtype=torch.bool, device=rim.start.device
    )
    for vertex in (rim.start, rim.end):
        is_chosen.scatter_(1, torch.where(rim.is_real, vertex, num_vertices), True)
    is_chosen = is_chosen[:, :num_vertices]
    return packed(is_chosen)[0], (is_chosen.cumsum(dim=1) - 1).clamp(min=0)


def pixel_slopes(
    points: Float[Tensor, "B C 3"], slopes: Float[Tensor, "B C 3 P"], targets: Targets
) -> Float[Tensor, "B C 2 P"]:
    """Slopes of points' pixels to the parameters, from those of the points."""
    placed = points + targets.anchor[:, None]
    depth = placed[..., 2:, None]
    across = slopes[..., :2, :] - placed[..., :2, None] / depth * slopes[..., 2:, :]
    return across * (targets.focal[:, None, :, None] / depth)


def rim_rows(targets: Targets, seen: Visible) -> Rows:
    """The model's rim in the target's signed distance field."""
    residuals, way = _look_up(targets.distance, seen.start + seen.way / 2)
    place = torch.full_like(residuals, 0.5)
    weights = _weight(seen.lengths, residuals, targets)
    return Rows(seen.rim.start, seen.rim.end, place, way, residuals, weights)


def contour_rows(targets: Targets, seen: Visible) -> Rows:
    """The target's contour to the nearest rim edge that faces the same way."""
    edge, is_found = _nearest(targets, seen)
    fits = torch.arange(len(edge), device=edge.device)[:, None]
    start, way, normals = (part[fits, edge] for part in (seen.start, seen.way, seen.normals))
    to_point = targets.contour - start
    length2 = way.square().sum(dim=2).clamp(min=1e-18)
    place = ((to_point * way).sum(dim=2) / length2).clamp(0.0, 1.0)
    gap = place[..., None] * way - to_point
    outward = (gap * normals).sum(dim=2)
    distance = gap.norm(dim=2)
    is_far = distance > 0.25
    side = torch.where(outward >= 0, 1.0, -1.0).to(gap.dtype)
    unit = side[..., None] * gap / distance[..., None].clamp(min=1e-9)
    residuals = torch.where(is_far, side * distance, outward) * is_found
    lengths = targets.contour_lengths * is_found
    return Rows(
        seen.rim.start[fits, edge],
        seen.rim.end[fits, edge],
        place,
        torch.where(is_far[..., None], unit, normals),
        residuals,
        _weight(lengths, residuals, targets),
    )


def weighted_squares(
    rows: Rows, index: Int[Tensor, "B V"], slopes: Float[Tensor, "B C 2 P"]
) -> tuple[Float[Tensor, "B P P"], Float[Tensor, "B P"]]:
    """H = sum w r r^T and g = sum w r residual; `slopes` of vertex v are in row `index[v]`."""
    fits = torch.arange(len(index), device=index.device)[:, None]
    near, far = (
        torch.einsum("bni,bnip->bnp", rows.way, slopes[fits, index.gather(1, vertex)])
        for vertex in (rows.first, rows.second)
    )
    lines = torch.lerp(near, far, rows.place[..., None])
    weighted = (rows.weights[..., None] * lines).transpose(1, 2)
    return weighted @ lines, (weighted @ rows.residuals[..., None])[..., 0]


def joined(first: Rows, second: Rows) -> Rows:
    """The rows of both."""
    return Rows(*(torch.cat(parts, dim=1) for parts in zip(first, second, strict=True)))


def regularisers(
    model: Model, targets: Targets, flat: Float[Tensor, "B P"], lambdas: Float[Tensor, "6"]
) -> tuple[Float[Tensor, "B P P"], Float[Tensor, "B P"]]:
    """L_s and L_t of eq. (4), the priors, and the gauge."""
    count = len(model.rest)
    linear = model.priors[1:].repeat(len(model.joints))
    linear.view(-1, JOINT)[:, 3:6] += 2 * lambdas[3]
    constant = flat.new_zeros(count, count)
    joints = constant[ROOT:, ROOT:]
    joints.diagonal().add_(linear)
    turns = joints.view(len(model.joints), JOINT, len(model.joints), JOINT)[:, :3, :, :3]
    turns += _GAUGE * torch.eye(3, dtype=flat.dtype, device=flat.device)[:, None]
    g = (flat - model.rest) @ constant
    H = constant.repeat(len(flat), 1, 1)
    scales = flat[:, ROOT + 6 :: JOINT].exp()
    g[:, ROOT + 6 :: JOINT] += 2 * lambdas[2] * scales * (scales - 1)
    H.diagonal(dim1=1, dim2=2)[:, ROOT + 6 :: JOINT] += 2 * lambdas[2] * scales.square()
    R, J = rotation(flat[:, :3])
    tilt = (targets.plane_normal * R[:, :, 0]).sum(dim=1, keepdim=True)
    slope = torch.einsum("bi,bim->bm", targets.plane_normal, turn_slope(R, J)[:, 0])
    g[:, :3] += model.priors[0] * tilt * slope
    H[:, :3, :3] += model.priors[0] * slope[:, :, None] * slope[:, None]
    return H, g


def prior_loss(model: Model, targets: Targets, flat: Float[Tensor, "B P"]) -> Float[Tensor, "B"]:
    """What the priors add to L_rec."""
    R, _ = rotation(flat[:, :3])
    tilt = (targets.plane_normal * R[:, :, 0]).sum(dim=1)
    away = (model.joint_values(flat) - model.rest[ROOT:].view(-1, JOINT)).square()
    return 0.5 * (model.priors[0] * tilt.square() + (away @ model.priors[1:]).sum(dim=1))


def _nearest(targets: Targets, seen: Visible) -> tuple[Int[Tensor, "B C"], Bool[Tensor, "B C"]]:
    """The rim edge nearest to each point of the contour, if any faces the same way.

    All pairs of points and edges: the largest tensors of an iteration, so worked on in place.
    """
    x, y = targets.contour[..., None].unbind(dim=2)
    start_x, start_y = seen.start[:, None].unbind(dim=3)
    way_x, way_y = seen.way[:, None].unbind(dim=3)
    scale = 1.0 / (way_x.square() + way_y.square()).clamp(min=1e-18)
    away_x, away_y = x - start_x, y - start_y
    along = (away_x * way_x).add_(away_y * way_y).mul_(scale).clamp_(0.0, 1.0)
    away_x -= along * way_x
    away_y -= along.mul_(way_y)
    squared = away_x.square_().add_(away_y.square_())
    agreement = targets.contour_normals @ seen.normals.transpose(1, 2)
    is_candidate = (agreement >= _SAME_WAY) & seen.rim.is_real[:, None]
    squared.masked_fill_(~is_candidate, torch.inf)
    least, edge = squared.min(dim=2)
    return edge, torch.isfinite(least)


def _look_up(
    field: Float[Tensor, "B S S"], places: Float[Tensor, "B N 2"]
) -> tuple[Float[Tensor, "B N"], Float[Tensor, "B N 2"]]:
    """Values and unit gradients of distance fields between pixels; they go on outside."""
    size = field.shape[1]
    inner = places.clamp(0.0, size - 1.001)
    corner = inner.long()
    fx, fy = (inner - corner).unbind(dim=2)
    cell = corner[..., 1] * size + corner[..., 0]
    flat = field.flatten(1)
    f00, f01, f10, f11 = (flat.gather(1, cell + step) for step in (0, 1, size, size + 1))
    value = torch.lerp(torch.lerp(f00, f01, fx), torch.lerp(f10, f11, fx), fy)
    gradient = torch.stack(
        [torch.lerp(f01 - f00, f11 - f10, fy), torch.lerp(f10 - f00, f11 - f01, fx)], dim=2
    )
    out = places - inner
    gradient = gradient + out
    length = gradient.norm(dim=2, keepdim=True)
    is_flat = length < 1e-9
    unit = torch.where(is_flat, 0.0, gradient / length.clamp(min=1e-9))
    return torch.where(is_flat[..., 0], value, value + out.norm(dim=2)), unit


def _weight(
    lengths: Float[Tensor, "B N"], residuals: Float[Tensor, "B N"], targets: Targets
) -> Float[Tensor, "B N"]:
    per_px = 1.0 / (targets.mask_area[:, None] * residuals.abs().clamp(min=_FLAT_PX))
    return 0.5 * lengths * (per_px + 100.0 / targets.mask.shape[1] ** 3)
