"""Where the fits of a batch begin when the frame before is known."""

import torch
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.batched.deformation import deform
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.outline import project
from stream_dmr.fitting.batched.targets import Targets


def recentered(model: Model, targets: Targets, flat: Float[Tensor, "B P"]) -> Float[Tensor, "B P"]:
    """Moved sideways so that each silhouette's middle falls on its mask's."""
    pixels = project(deform(model, flat).points[:, : model.num_vertices], targets)
    gap = _middle(targets.mask) - (pixels.amin(dim=1) + pixels.amax(dim=1)) / 2
    moved = flat.clone()
    moved[:, 3:5] += gap / (flat[:, 5:6].exp() * targets.focal)
    return moved


def _middle(mask: Float[Tensor, "B S S"]) -> Float[Tensor, "B 2"]:
    """Middle (x, y) of the box around each mask, px."""
    ends = []
    for along in (1, 2):
        is_in = (mask > 0.5).any(dim=along).to(mask.dtype)
        last = mask.shape[along] - 1 - is_in.flip(1).argmax(dim=1)
        ends.append((is_in.argmax(dim=1) + last) / 2)
    return torch.stack(ends, dim=1).to(mask.dtype)
