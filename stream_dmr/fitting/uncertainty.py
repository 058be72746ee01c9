"""How sure a fit is: the covariance of its parameters by the outline's own curvature.

At the optimum each place of the visible rim says how far the outline moves across itself when a
parameter moves. With edges that are off by `edge_std_px` over stretches of `edge_correlation_px`,
those are the rows of a linear least-squares problem whose normal matrix, with the prior, is the
inverse of the covariance. A bend toward the camera moves the outline little and gets a large
variance; so does the length of a fish that may be turned away.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.objective import Objective
from stream_dmr.silhouette import rim_edges, silhouette
from stream_dmr.skinning import Deformed

# What is known of the parameters before any picture, as standard deviations: rotations of the root
# and the joints (rad), their translations (body lengths), log scales, log precisions.
_ROOT_PRIOR = [2.0] * 3 + [1.0] * 2 + [1.0]
_JOINT_PRIOR = [1.0] * 3 + [0.03] * 3 + [0.1] + [1.0] * 6
_STEP = 1e-4


def covariance(
    objective: Objective, flat: Float[Tensor, "P"]
) -> tuple[Float[Tensor, "P P"], float]:
    """Covariance of the parameters of a fit, and the std of its length as a fraction of it."""
    settings = objective.settings
    rim, normals, lengths = _visible_rim(objective, flat)
    steps = _STEP * torch.eye(len(flat), dtype=flat.dtype, device=flat.device)
    shapes = objective.deform(torch.cat([flat + steps, flat - steps]))
    pixels = objective.project(shapes.vertices)[:, rim]
    forward, backward = pixels.chunk(2)
    slopes = (((forward - backward) / (2 * _STEP)) * normals).sum(dim=-1)  # (P, N), px
    weight = lengths / (settings.edge_correlation_px * settings.edge_std_px**2)
    joints = (len(flat) - 6) // 13
    prior = torch.tensor(_ROOT_PRIOR + _JOINT_PRIOR * joints, dtype=flat.dtype, device=flat.device)
    information = (slopes * weight) @ slopes.T + torch.diag(prior**-2)
    spread = torch.linalg.inv(information)
    forward, backward = log_length(shapes).chunk(2)
    slope = (forward - backward) / (2 * _STEP)
    return spread, float((slope @ spread @ slope).sqrt())


def log_length(shape: Deformed) -> Float[Tensor, "B"]:
    """Log of the arc length along the midline, at the fixed depth of the root."""
    return (shape.midline[:, 1:] - shape.midline[:, :-1]).norm(dim=-1).sum(dim=1).log()


def _visible_rim(
    objective: Objective, flat: Float[Tensor, "P"]
) -> tuple[Tensor, Float[Tensor, "N 2"], Float[Tensor, "N"]]:
    """Vertices of the rim that bound the silhouette, with the outline's normals and lengths."""
    pixels = objective.project(objective.deform(flat[None]).vertices)
    rim = rim_edges(pixels, objective.rig)
    start, end = pixels[0, rim.start], pixels[0, rim.end]
    step = end - start
    length = step.norm(dim=1)
    normal = torch.stack([step[:, 1], -step[:, 0]], dim=1) / length.clamp(min=1e-12)[:, None]
    size = objective.target.mask.shape[0]
    covered = silhouette(pixels, objective.rig, size=size)[0]
    outside = ((start + end) / 2 + normal).round().long().clamp(0, size - 1)
    is_visible = covered[outside[:, 1], outside[:, 0]] < 0.5
    return rim.start[is_visible], normal[is_visible], length[is_visible]
