"""The losses that the network is trained by, and the scores that it is judged by."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, log_softmax, max_pool2d

from stream_dmr.segmentation.network.unet_interface import ENDS_STRIDE

_THIN_SHARE = 0.036  # of the picture's side: wider than a tail seen edge-on
# Added to the weight 1 of every pixel. Without it IoU on the foreign `realistic` scene was 0.918
# instead of 0.930 (docs/research/network-weights.md).
_THIN_WEIGHT = 4.0
_ENDS_SPREAD = 1.0  # standard deviation of the target's blob, cells
_ENDS_WEIGHT = 0.08  # of the ends' loss beside the mask's: chosen by hand: the mask matters more


def mask_loss(logits: Float[Tensor, "B S S"], masks: Float[Tensor, "B S S"]) -> Float[Tensor, ""]:
    """2 x weighted cross entropy, which calibrates probabilities, + 1 - soft IoU, for thin fish.

    soft IoU = (sum p t + 1) / (sum (p + t - p t) + 1) per image. Thin parts weigh more in the cross
    entropy: a tail is few pixels of the mask but a tenth of the length.
    """
    weights = 1 + _THIN_WEIGHT * _thin(masks)
    entropy = binary_cross_entropy_with_logits(logits, masks, weight=weights)
    probability = torch.sigmoid(logits)
    both = (probability * masks).sum(dim=(1, 2))
    either = (probability + masks - probability * masks).sum(dim=(1, 2))
    return 2 * entropy + (1 - (both + 1) / (either + 1)).mean()


def _thin(masks: Float[Tensor, "B S S"]) -> Float[Tensor, "B S S"]:
    """The parts of the masks narrower than `_THIN_SHARE`: mask minus its morphological opening."""
    half = round(_THIN_SHARE * masks.shape[-1] / 2)
    shrunk = -max_pool2d(-masks, 2 * half + 1, stride=1, padding=half)
    return masks - max_pool2d(shrunk, 2 * half + 1, stride=1, padding=half)


def ends_loss(
    logits: Float[Tensor, "B 2 s s"], ends_px: Float[Tensor, "B 2 2"]
) -> Float[Tensor, ""]:
    """Cross entropy over all cells of each end's map, against a Gaussian at the true end.

    Ends outside the image, or NaN, do not count.
    """
    size = logits.shape[-1]
    cells = (ends_px + 0.5) / ENDS_STRIDE - 0.5
    is_inside = ((cells > -0.5) & (cells < size - 0.5)).all(dim=2)
    index = torch.arange(size, device=logits.device)
    distance = index - torch.nan_to_num(cells)[..., None]  # B, 2 ends, x and y, s
    x, y = torch.exp(-0.5 * (distance / _ENDS_SPREAD).square()).unbind(dim=2)
    target = y[..., :, None] * x[..., None, :]
    target = (target / (target.sum(dim=(2, 3), keepdim=True) + 1e-9)).flatten(2)
    entropy = -(target * log_softmax(logits.flatten(2), dim=2)).sum(dim=2)
    return _ENDS_WEIGHT * (entropy * is_inside).sum() / is_inside.sum().clamp(min=1)


def mask_iou(logits: Float[Tensor, "B S S"], masks: Float[Tensor, "B S S"]) -> Float[Tensor, "B"]:
    """Intersection over union of each pair of masks, at probability 0.5; 1 where both are empty."""
    found, true = logits > 0, masks > 0.5
    both, either = (found & true).sum(dim=(1, 2)), (found | true).sum(dim=(1, 2))
    return torch.where(
        either > 0, both / either.clamp(min=1), torch.ones_like(both, dtype=torch.float32)
    )


def ends_are_right(
    logits: Float[Tensor, "B 2 s s"], ends_px: Float[Tensor, "B 2 2"]
) -> tuple[Bool[Tensor, "B"], Bool[Tensor, "B"]]:
    """Per image: true where the found head is nearer to the true head than to the true tail.

    The second tensor is false where the true ends are unknown.
    """
    size = logits.shape[-1]
    peak = logits[:, 0].flatten(1).argmax(dim=1)
    found = torch.stack([peak % size, peak // size], dim=1) * ENDS_STRIDE + (ENDS_STRIDE - 1) / 2
    to_head, to_tail = (found[:, None] - ends_px).norm(dim=2).unbind(dim=1)
    return to_head < to_tail, ~ends_px.isnan().any(dim=(1, 2))
