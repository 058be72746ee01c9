"""The differentiable silhouette: the exact share of each pixel that the mesh covers.

A soft rasterizer blurs the outline and thereby dilates it. Here nothing is blurred: the outline of
a closed mesh is made of its rim edges (between a face that looks at the camera and one that does
not), and the area that directed edges enclose inside each pixel has a closed form. Summed over the
rim this counts the layers of the body that lie over each pixel; where it is folded over itself the
count exceeds 1, and clamping it gives the silhouette. No depth buffer, no blur, no parameter.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.fitting.paper.skinning import Rig


def project(points: Float[Tensor, "B N 3"], K: Float[Tensor, "3 3"]) -> Float[Tensor, "B N 2"]:
    """Pixels of points in front of an ideal pinhole camera, x right and y down."""
    return points[..., :2] / points[..., 2:] * K[[0, 1], [0, 1]] + K[:2, 2]


def silhouette(
    vertices_px: Float[Tensor, "B V 2"], rig: Rig, *, size: int
) -> Float[Tensor, "B S S"]:
    """Covered share in [0, 1] of each pixel of a square picture; differentiable in the vertices.

    Exact but where two different outlines pass through one pixel of a folded body. After the
    signed-area accumulation of font rasterizers; its derivative is the boundary integral of the
    rim's normal velocity (Reynolds' transport theorem).
    """
    rim = rim_edges(vertices_px.detach(), rig)
    start = vertices_px[rim.batch, rim.start]
    end = vertices_px[rim.batch, rim.end]
    layers = _Coverage.apply(start, end, rim.batch, vertices_px.shape[0], size)
    return layers.clamp(0.0, 1.0)


# Left, right, top, bottom: cells for what lies outside the picture, and one more column that takes
# what falls to the right of the last cell of a row.
_PADDING = (1, 2, 1, 1)


class Rim(NamedTuple):
    """Rim edges of a batch of meshes, directed so that the body lies on one and the same side."""

    batch: Int[Tensor, "N"]
    start: Int[Tensor, "N"]
    end: Int[Tensor, "N"]


def rim_edges(vertices_px: Float[Tensor, "B V 2"], rig: Rig) -> Rim:
    """The edges between faces that look at the camera and faces that look away."""
    a, b, c = vertices_px[:, rig.faces].unbind(dim=2)
    ab, ac = b - a, c - a
    # Counter-clockwise outside becomes clockwise in pixels, whose y points down.
    is_front = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0] < 0
    along, against = is_front[:, rig.edge_faces].unbind(dim=2)
    batch, edge = torch.nonzero(along != against, as_tuple=True)
    is_along = along[batch, edge]
    first, second = rig.edges[edge].unbind(dim=1)
    return Rim(batch, torch.where(is_along, second, first), torch.where(is_along, first, second))


class _Pieces(NamedTuple):
    """Rim edges cut at the borders of pixels: each piece lies in one cell of the padded grid."""

    edge: Int[Tensor, "K"]
    cell: Int[Tensor, "K"]  # flat index into the padded grid (batch, size + 2, size + 3)
    t0: Float[Tensor, "K"]
    t1: Float[Tensor, "K"]


class _Coverage(torch.autograd.Function):
    """Layers over each pixel from directed edges; the backward pass is a boundary integral."""

    @staticmethod
    def forward(
        ctx: Any, start: Tensor, end: Tensor, batch: Tensor, num_batches: int, size: int
    ) -> Tensor:
        pieces = _cut(start, end, batch, size)
        grid = _accumulate(start, end, pieces, num_batches, size)
        ctx.save_for_backward(start, end, *pieces)
        return grid[:, 1 : size + 1, 1 : size + 1].contiguous()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        start, end, edge, cell, t0, t1 = ctx.saved_tensors
        at_piece = torch.nn.functional.pad(grads[0], _PADDING).flatten()[cell]
        step = end - start
        # Area swept by a piece when its edge's ends move: the integral over t in [t0, t1] of
        # normal . ((1 - t) d_start + t d_end).
        to_end = (t1.square() - t0.square()) / 2
        to_start = (t1 - t0) - to_end
        weights = torch.stack([to_start, to_end], dim=1) * at_piece[:, None]
        sums = torch.zeros(len(start), 2, dtype=start.dtype, device=start.device)
        sums.index_add_(0, edge, weights)
        normal = torch.stack([step[:, 1], -step[:, 0]], dim=1)
        return sums[:, :1] * normal, sums[:, 1:] * normal, None, None, None


def _cut(start: Tensor, end: Tensor, batch: Tensor, size: int) -> _Pieces:
    """Cut edges where they cross the borders of pixels (at half-integers)."""
    low, high = torch.minimum(start, end), torch.maximum(start, end)
    first = torch.ceil(low + 0.5).clamp(0, size)  # first border, as the index of the pixel after it
    count = (torch.floor(high + 0.5).clamp(-1, size) - first + 1).clamp(min=0)
    most = int(count.max()) if len(start) else 0
    borders = first[..., None] - 0.5 + torch.arange(most, dtype=start.dtype, device=start.device)
    step = end - start
    safe = torch.where(step == 0, torch.ones_like(step), step)
    t = (borders - start[..., None]) / safe[..., None]
    is_crossed = torch.arange(most, device=start.device) < count[..., None]
    t = torch.where(is_crossed & (step != 0)[..., None], t.clamp(0.0, 1.0), 1.0).flatten(1)
    ends = torch.zeros_like(start[:, :1])
    t = torch.cat([ends, t, ends + 1], dim=1).sort(dim=1).values
    edge, piece = torch.nonzero(t[:, 1:] > t[:, :-1], as_tuple=True)
    t0, t1 = t[edge, piece], t[edge, piece + 1]
    middle = start[edge] + ((t0 + t1) / 2)[:, None] * step[edge]
    column, row = (torch.floor(middle + 0.5).clamp(-1, size).long() + 1).unbind(dim=1)
    cell = (batch[edge] * (size + 2) + row) * (size + 3) + column
    return _Pieces(edge, cell, t0, t1)


def _accumulate(start: Tensor, end: Tensor, pieces: _Pieces, num_batches: int, size: int) -> Tensor:
    """Signed area to the right of each piece: partly in its own cell, fully in those after it."""
    width = size + 3
    step = (end - start)[pieces.edge]
    fall = (pieces.t1 - pieces.t0) * step[:, 1]
    middle_x = start[pieces.edge, 0] + (pieces.t0 + pieces.t1) / 2 * step[:, 0]
    column = pieces.cell % width
    share = (column - 0.5 - middle_x).clamp(0.0, 1.0)  # of the cell that lies right of the piece
    grid = torch.zeros(num_batches * (size + 2) * width, dtype=start.dtype, device=start.device)
    own = -fall * share
    grid.index_add_(0, pieces.cell, own)
    grid.index_add_(0, pieces.cell + 1, -fall - own)
    return grid.view(num_batches, size + 2, width).cumsum(dim=2)
