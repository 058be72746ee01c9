"""The reconstruction loss (paper, Sec. 2.2, eq. (3)-(5)): each term one small function.

Every term is batched: it takes B fits at once and returns B numbers, before its lambda.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.paper.skinning import Rig


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
