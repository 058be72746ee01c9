"""L_normal and L_lap of eq. (5) for a batch, with the forces that they exert on the vertices.

The formulas of `contour/mesh_terms.py`.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.batched.model import Model


class Smoothness(NamedTuple):
    """Both terms of bodies at size 1, and the slope of their weighted sum."""

    normal: Float[Tensor, "B"]
    laplacian: Float[Tensor, "B"]
    forces: Float[Tensor, "B V 3"]  # to the vertices, at a fixed size
    size_slope: Float[Tensor, "B"]  # to the log of the size, at fixed vertices


def smoothness(
    model: Model,
    vertices: Float[Tensor, "B V 3"],
    size: Float[Tensor, "B"],
    lambdas: Float[Tensor, "6"],
) -> Smoothness:
    """Both terms, weighted by the last two lambdas in the slopes."""
    normal, forces = _normal(model, vertices, lambdas[4])
    laplacian, pulls = _laplacian(model, vertices)
    weight = lambdas[5] / size.square()
    forces = forces.add_(weight[:, None, None] * pulls)
    return Smoothness(normal, laplacian / size.square(), forces, -2 * weight * laplacian)


def _normal(
    model: Model, vertices: Float[Tensor, "B V 3"], weight: Float[Tensor, ""]
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B V 3"]]:
    """Sum_e (1 - n_p . n_q) and its slope, by that of each face's normal n = N / |N|, N = u x v."""
    a, b, c = vertices[:, model.faces].unbind(dim=2)
    u, v = b - a, c - a
    cross = torch.linalg.cross(u, v)
    scale = 1.0 / cross.norm(dim=2, keepdim=True).clamp(min=1e-30)
    normals = cross * scale
    first, second = normals[:, model.edge_faces].unbind(dim=2)
    value = (1.0 - (first * second).sum(dim=2)).sum(dim=1)
    pulls = torch.zeros_like(normals)
    pulls.index_add_(1, model.edge_faces[:, 0], second)
    pulls.index_add_(1, model.edge_faces[:, 1], first)
    along = (pulls * normals).sum(dim=2, keepdim=True)
    w = -weight * scale * (pulls - along * normals)
    to_b, to_c = torch.linalg.cross(v, w), torch.linalg.cross(w, u)
    forces = torch.zeros_like(vertices)
    for corner, force in enumerate((-to_b - to_c, to_b, to_c)):
        forces.index_add_(1, model.faces[:, corner], force)
    return value, forces


def _laplacian(
    model: Model, vertices: Float[Tensor, "B V 3"]
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B V 3"]]:
    """Sum_v |p_v - mean of its neighbours|^2 and its slope."""
    off = vertices - model.neighbor_share * _neighbor_sums(model, vertices)
    slope = 2 * (off - _neighbor_sums(model, model.neighbor_share * off))
    return off.square().sum(dim=(1, 2)), slope


def _neighbor_sums(model: Model, values: Float[Tensor, "B V 3"]) -> Float[Tensor, "B V 3"]:
    first, second = model.edges.unbind(dim=1)
    sums = torch.zeros_like(values).index_add_(1, first, values[:, second])
    return sums.index_add_(1, second, values[:, first])
