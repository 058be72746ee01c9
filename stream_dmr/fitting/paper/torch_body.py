"""The deformed body and its silhouette in torch, differentiable.

Two deformations, eq. (1)-(2) of the paper (Sec. 2.1) and the spine that keeps length, share their
parameters: a root rotation, translation and scale, and for each joint a rotation, a translation, a
scale and the precision Q of its Gaussian skinning weight. The root's translation has no depth:
under a perspective camera depth and scale of one silhouette can't be distinguished, so the root
stays at depth 1 and the localization finds the millimetres.

The silhouette is the exact share of each pixel that the mesh covers; a soft rasterizer blurs the
outline and thereby dilates it. The outline of a closed mesh is made of its rim edges (between a
face that looks at the camera and one that does not), and the area that directed edges enclose
inside each pixel has a closed form. Summed over the rim this counts the layers of the body that lie
over each pixel; where it is folded over itself the count exceeds 1, and clamping it gives the
silhouette. No depth buffer, no blur, no parameter.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.fitting.body import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    JOINT_WEIGHT,
    LOG_SIZE,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_ROTATION,
    ROOT_TRANSLATION,
    Body,
)
from stream_dmr.template.template import Template


class Parameters(NamedTuple):
    """The parameters of a batch of B deformations with J joints, as views of one (B, P) tensor."""

    root_rotation: Float[Tensor, "B 3"]  # rotation vector, rad
    root_translation: Float[Tensor, "B 2"]  # x, y of the camera frame, body lengths
    root_log_scale: Float[Tensor, "B"]  # log of the body length over the depth
    joint_rotations: Float[Tensor, "B J 3"]  # rotation vectors, rad
    joint_translations: Float[Tensor, "B J 3"]  # body lengths
    joint_log_scales: Float[Tensor, "B J"]
    joint_precisions: Float[Tensor, "B J 6"]  # Cholesky factor of Q, its diagonal as logs

    @classmethod
    def from_vector(cls, vector: Float[Tensor, "B P"]) -> "Parameters":
        """Split vectors as `stream_dmr.fitting.body` lays them out."""
        joints = vector[:, NUM_ROOT:].unflatten(1, (-1, NUM_PER_JOINT))
        return cls(
            root_rotation=vector[:, ROOT_ROTATION],
            root_translation=vector[:, ROOT_TRANSLATION],
            root_log_scale=vector[:, LOG_SIZE],
            joint_rotations=joints[..., JOINT_ROTATION],
            joint_translations=joints[..., JOINT_TRANSLATION],
            joint_log_scales=joints[..., JOINT_LOG_SCALE],
            joint_precisions=joints[..., JOINT_WEIGHT],
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Rig:
    """A `Body` as tensors, float64 throughout."""

    points: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    edges: Int[Tensor, "E 2"]
    edge_faces: Int[Tensor, "E 2"]
    num_neighbors: Float[Tensor, "V"]  # of each vertex along the edges
    joints: Float[Tensor, "J 3"]
    midline: Float[Tensor, "M 3"]
    feet: Float[Tensor, "N 3"]  # of the points on the midline
    foot_segments: Int[Tensor, "N"]  # midline segment of each foot
    foot_fractions: Float[Tensor, "N"]  # place of the foot in its segment, 0 to 1
    num_vertices: int

    @classmethod
    def from_template(cls, template: Template, *, device: str = "cpu") -> "Rig":
        """Bind a template's points to its midline and move it to a device."""
        body = Body.from_template(template)
        arrays = {
            "points": body.points,
            "faces": body.faces,
            "edges": body.edges,
            "edge_faces": body.edge_faces,
            "num_neighbors": np.diff(body.edge_starts).astype(float),
            "joints": body.joints,
            "midline": body.midline,
            "feet": body.places[body.place_of],
            "foot_segments": body.segments[body.place_of],
            "foot_fractions": body.fractions[body.place_of],
        }
        tensors = {name: torch.as_tensor(array, device=device) for name, array in arrays.items()}
        return cls(**tensors, num_vertices=body.num_vertices)


class Deformed(NamedTuple):
    """A batch of deformed templates, centered on the root, in units of the root's depth."""

    vertices: Float[Tensor, "B V 3"]
    keypoints: Float[Tensor, "B 3 3"]
    midline: Float[Tensor, "B M 3"]


Deformation = Callable[[Rig, Parameters], Float[Tensor, "B N 3"]]


def linear_blend(rig: Rig, parameters: Parameters) -> Float[Tensor, "B N 3"]:
    """Eq. (1) and (2) to the letter: the joints' rotation matrices are blended as matrices.

    A blend of rotations is no rotation: it shrinks the middle of a bent body.
    """
    weights = skinning_weights(rig.points, rig.joints, parameters.joint_precisions)
    rotations = rotation_matrices(parameters.joint_rotations)
    root = rotation_matrices(parameters.root_rotation)
    # Rotation: V <- R_0 (sum_j W_j R_j) V
    blended = torch.einsum("bnj,bjkl->bnkl", weights, rotations)
    points = torch.einsum("bkl,bnlm,nm->bnk", root, blended, rig.points)
    # Translation: V <- T_0 + (sum_j W_j T_j) + V
    points = points + weights @ parameters.joint_translations
    points = points + _with_depth(parameters.root_translation)[:, None]
    # Scaling: V <- S_0 (sum_j W_j S_j) V
    scale = torch.einsum("bnj,bj->bn", weights, parameters.joint_log_scales.exp())
    return points * scale[..., None] * parameters.root_log_scale.exp()[:, None, None]


def spine(rig: Rig, parameters: Parameters) -> Float[Tensor, "B N 3"]:
    """The length-keeping variant: rotations are blended as rotations, and the body is swept.

    At each place s of the midline the joints give one rotation R(s) = exp(sum_j W_j(s) log R_j)
    and one scale S(s). The bent midline is the integral of R(s) m'(s), so its length is the root's
    scale alone; each cross-section moves with the frame at its foot, S(s) times as broad and thick.
    """
    nodes = rig.midline
    middles = (nodes[1:] + nodes[:-1]) / 2
    rotation, _, _ = _frames(rig, parameters, middles)
    steps = torch.einsum("bmkl,ml->bmk", rotation, nodes[1:] - nodes[:-1])
    bent = torch.cat([torch.zeros_like(steps[:, :1]), steps.cumsum(dim=1)], dim=1)
    place = bent[:, rig.foot_segments] + rig.foot_fractions[:, None] * steps[:, rig.foot_segments]
    center = place[:, rig.num_vertices + 1][:, None]  # the foot of the center keypoint is the root

    rotation, scale, shift = _frames(rig, parameters, rig.feet)
    offset = scale[..., None] * (rig.points - rig.feet) + shift
    points = place - center + torch.einsum("bnkl,bnl->bnk", rotation, offset)
    root = rotation_matrices(parameters.root_rotation)
    points = points @ root.transpose(1, 2) + _with_depth(parameters.root_translation)[:, None]
    return points * parameters.root_log_scale.exp()[:, None, None]


DEFORMATIONS: dict[str, Deformation] = {"spine": spine, "linear-blend": linear_blend}


def deform(rig: Rig, vector: Float[Tensor, "B P"], deformation: Deformation) -> Deformed:
    points = deformation(rig, Parameters.from_vector(vector))
    v = rig.num_vertices
    return Deformed(points[:, :v], points[:, v : v + 3], points[:, v + 3 :])


def skinning_weights(
    points: Float[Tensor, "N 3"], joints: Float[Tensor, "J 3"], precisions: Float[Tensor, "B J 6"]
) -> Float[Tensor, "B N J"]:
    """W_ji = C exp(-1/2 (V_i - V_j)^T Q_j (V_i - V_j)), eq. (2); rows sum to 1.

    Q = L L^T with a positive diagonal of L, so Q stays positive definite whatever is learnt.
    """
    L = cholesky_factors(precisions)
    difference = points[:, None] - joints
    scaled = torch.einsum("bjkl,njk->bnjl", L, difference)
    return torch.softmax(-0.5 * scaled.square().sum(dim=-1), dim=-1)


def rotation_matrices(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues' formula, smooth at the identity."""
    x, y, z = rotvec.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    # The root of the sum is kept away from 0, where its derivative has no limit.
    angle = (rotvec.square().sum(dim=-1) + 1e-30).sqrt()[..., None, None]
    half = torch.sinc(angle / (2 * torch.pi))
    identity = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return identity + torch.sinc(angle / torch.pi) * cross + 0.5 * half.square() * (cross @ cross)


def _frames(
    rig: Rig, parameters: Parameters, places: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "B N 3 3"], Float[Tensor, "B N"], Float[Tensor, "B N 3"]]:
    """Blended rotation, scale and translation at places of the midline."""
    weights = skinning_weights(places, rig.joints, parameters.joint_precisions)
    rotation = rotation_matrices(weights @ parameters.joint_rotations)
    scale = torch.einsum("bnj,bj->bn", weights, parameters.joint_log_scales.exp())
    return rotation, scale, weights @ parameters.joint_translations


def _with_depth(translation: Float[Tensor, "B 2"]) -> Float[Tensor, "B 3"]:
    return torch.nn.functional.pad(translation, (0, 1))


def cholesky_factors(precisions: Float[Tensor, "B J 6"]) -> Float[Tensor, "B J 3 3"]:
    """Lower triangular L from its logged diagonal and its entries (1,0), (2,0), (2,1)."""
    a, b, c = precisions[..., :3].exp().unbind(-1)
    d, e, f = precisions[..., 3:].unbind(-1)
    zero = torch.zeros_like(a)
    return torch.stack([a, zero, zero, d, b, zero, e, f, c], dim=-1).unflatten(-1, (3, 3))


def project(points: Float[Tensor, "B N 3"], K: Float[Tensor, "3 3"]) -> Float[Tensor, "B N 2"]:
    """Pixels of points in front of an ideal pinhole camera, x right and y down."""
    return points[..., :2] / points[..., 2:] * K[[0, 1], [0, 1]] + K[:2, 2]


def silhouette(
    vertices_px: Float[Tensor, "B V 2"], rig: Rig, *, size: int
) -> Float[Tensor, "B S S"]:
    """Covered share in [0, 1] of each pixel of a square picture; differentiable in the vertices.

    Exact unless two different outlines pass through one pixel of a folded body. After the
    signed-area accumulation of font rasterizers; its derivative is the boundary integral of the
    rim's normal velocity (Reynolds' transport theorem).
    """
    rim = rim_edges(vertices_px.detach(), rig)
    start = vertices_px[rim.batch, rim.start]
    end = vertices_px[rim.batch, rim.end]
    layers = _Coverage.apply(start, end, rim.batch, vertices_px.shape[0], size)
    return layers.clamp(0.0, 1.0)


# Left, right, top, bottom: cells for areas outside the picture, and one more column for areas to
# the right of the last cell of a row.
_PADDING = (1, 2, 1, 1)


class Rim(NamedTuple):
    """Rim edges of a batch of meshes, directed so that the body lies on the same side of all."""

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
    """Signed area to the right of each piece: partly in its own cell, fully in the cells after."""
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
