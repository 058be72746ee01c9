"""The outlines of a batch of bodies, and how well each covers its mask.

The same formulas as `contour/outline.py`. What differs in number from fit to fit is packed to the
left of rows that are as long as the longest needs, with a mask of what is real.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.targets import Targets

# Far outside any picture; what is not finite is put here, and its loss is not finite either.
_FAR_PX = 1e5


class Rim(NamedTuple):
    """Directed edges between faces that look at the camera and faces that look away."""

    start: Int[Tensor, "B R"]
    end: Int[Tensor, "B R"]
    is_real: Bool[Tensor, "B R"]


def project(points: Float[Tensor, "B N 3"], targets: Targets) -> Float[Tensor, "B N 2"]:
    """Pixels of points that are centered on the root."""
    placed = points + targets.anchor[:, None]
    pixels = placed[..., :2] / placed[..., 2:] * targets.focal[:, None] + targets.middle[:, None]
    return torch.nan_to_num(pixels, nan=_FAR_PX).clamp(-_FAR_PX, _FAR_PX)


def packed(is_wanted: Bool[Tensor, "B N"]) -> tuple[Int[Tensor, "B K"], Bool[Tensor, "B K"]]:
    """Where each row is true, in its order, and which of these places are real.

    K is the most of any row, but at least 1: a number that the host waits for.
    """
    counts = is_wanted.sum(dim=1)
    most = max(int(counts.max()), 1)
    # What is not wanted goes to one more column, which is cut off.
    place = torch.where(is_wanted, is_wanted.cumsum(dim=1) - 1, most)
    index = torch.zeros(len(counts), most + 1, dtype=torch.int64, device=counts.device)
    every = torch.arange(is_wanted.shape[1], device=counts.device).expand_as(is_wanted)
    index.scatter_(1, place, every)
    return index[:, :most], torch.arange(most, device=counts.device) < counts[:, None]


def rim_edges(pixels: Float[Tensor, "B V 2"], model: Model) -> Rim:
    """The rim of each body, directed so that the body lies on one and the same side."""
    a, b, c = pixels[:, model.faces].unbind(dim=2)
    ab, ac = b - a, c - a
    is_front = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0] < 0
    along, against = is_front[:, model.edge_faces].unbind(dim=2)
    edge, is_real = packed(along != against)
    is_along = along.gather(1, edge)
    first, second = model.edges[edge].unbind(dim=2)
    return Rim(torch.where(is_along, second, first), torch.where(is_along, first, second), is_real)


def ends(
    pixels: Float[Tensor, "B V 2"], rim: Rim
) -> tuple[Float[Tensor, "B R 2"], Float[Tensor, "B R 2"]]:
    """Pixels at which rim edges begin and end."""
    fits = torch.arange(len(pixels), device=pixels.device)[:, None]
    return pixels[fits, rim.start], pixels[fits, rim.end]


def coverage(pixels: Float[Tensor, "B V 2"], rim: Rim, size: int) -> Float[Tensor, "B S S"]:
    """Covered share of each pixel: signed areas of the rim edges, summed along rows.

    Each edge is cut at the borders of rows and each of these pieces at those of columns, all of
    them in flat lists, so that none is longer than it needs be.
    """
    start, end = (points + 0.5 for points in ends(pixels, rim))
    is_down = start[..., 1] <= end[..., 1]
    upper = torch.where(is_down[..., None], start, end).flatten(0, 1)
    lower = torch.where(is_down[..., None], end, start).flatten(0, 1)
    sign = torch.where(is_down, -1.0, 1.0).to(pixels.dtype).flatten()
    top, bottom = upper[:, 1].clamp(min=0), lower[:, 1].clamp(max=size)
    is_crossed = rim.is_real.flatten() & (top < bottom)
    edge, index = _repeated(torch.where(is_crossed, bottom.ceil() - top.floor(), 0.0))
    row = top[edge].floor() + index
    slope = ((lower - upper)[:, 0] / (lower - upper)[:, 1])[edge]
    high, low = torch.maximum(top[edge], row), torch.minimum(bottom[edge], row + 1)
    x, y = upper[edge].unbind(dim=1)
    pieces = torch.stack([x + (high - y) * slope, x + (low - y) * slope], dim=1)
    fit = edge // rim.start.shape[1]
    grid = torch.zeros(len(pixels) * size * (size + 1), dtype=pixels.dtype, device=pixels.device)
    first_cell = (fit * size + row.long()) * (size + 1)
    _add_pieces(grid, first_cell, pieces.sort(dim=1).values, sign[edge] * (low - high), size)
    return grid.view(-1, size, size + 1).cumsum(dim=2)[..., :size].clamp(0.0, 1.0)


def _add_pieces(grid: Tensor, first_cell: Tensor, spans: Tensor, area: Tensor, size: int) -> None:
    """Signed area right of pieces of edges within one row of pixels each, into the grid."""
    left, right = spans.unbind(dim=1)
    width = right - left
    per_x = torch.where(width > 0, area / width.clamp(min=1e-30), 0.0)
    before = torch.where(right <= 0, area, per_x * (-left).clamp(min=0))
    grid.index_add_(0, first_cell, before)
    start, stop = left.clamp(min=0), right.clamp(max=size)
    columns = (stop.ceil() - start.floor()).clamp(min=1)
    piece, index = _repeated(torch.where((left < size) & (right > 0), columns, 0.0))
    column = start[piece].floor() + index
    a, b = torch.maximum(start[piece], column), torch.minimum(stop[piece], column + 1)
    share = torch.where(width[piece] > 0, per_x[piece] * (b - a), area[piece])
    own = share * (column + 1 - (a + b) / 2)
    cell = first_cell[piece] + column.long()
    grid.index_add_(0, cell, own)
    grid.index_add_(0, cell + 1, share - own)


def _repeated(counts: Float[Tensor, "N"]) -> tuple[Int[Tensor, "K"], Int[Tensor, "K"]]:
    """Each index as often as it counts, and how often it has come before."""
    counts = counts.long()
    index = torch.repeat_interleave(counts)
    first = counts.cumsum(dim=0) - counts
    return index, torch.arange(len(index), device=counts.device) - first[index]


def overlap(
    covered: Float[Tensor, "B S S"], targets: Targets
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B"], Float[Tensor, "B"]]:
    """L_iou and L_boundary of eq. (3), and the hard IoU."""

    def shared(field: Tensor) -> Tensor:
        return (covered.flatten(1)[:, None] @ field.flatten(1)[..., None])[:, 0, 0]

    both = shared(targets.mask)
    iou = both / (covered.sum(dim=(1, 2)) + targets.mask_area - both)
    boundary = shared(targets.distance) * (100.0 / covered.shape[1] ** 3)
    hard = covered >= 0.5
    hard_both = (hard & (targets.mask > 0.5)).sum(dim=(1, 2))
    hard_iou = hard_both / (hard.sum(dim=(1, 2)) + targets.mask_area - hard_both)
    return 1.0 - iou, boundary, hard_iou
