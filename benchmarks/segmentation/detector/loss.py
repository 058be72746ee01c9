"""What YOLOX should give: cells near the middle of a fish have its box (Ge et al., 2021)."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

STRIDES = (8, 16, 32)  # input pixels per cell of each level
_SIZES = ((0.0, 96.0), (40.0, 200.0), (96.0, 1e9))  # of fish that a level answers for, px
_RADIUS = 1.5  # cells around the middle of a fish that answer for it
_BOX_WEIGHT = 5.0  # as YOLOX
_LEAST_SCORE = 0.3  # that a cell in the middle of a fish should give, however bad its box


def decode(outputs: list[Tensor]) -> tuple[Float[Tensor, "B N 4"], Float[Tensor, "B N"]]:
    """Boxes as left, top, right, bottom in px, and the logits of their scores.

    `outputs`: of each level, boxes (B, 4, h, w) and logits (B, 1, h, w).
    """
    boxes, logits = [], []
    for stride, box, logit in zip(STRIDES, outputs[::2], outputs[1::2], strict=True):
        cells = _cells(box.shape[2], box.shape[3])
        middle = (box[:, :2].flatten(2).transpose(1, 2) + cells) * stride
        half = box[:, 2:].flatten(2).transpose(1, 2).clamp(max=8.0).exp() * stride / 2
        boxes.append(torch.cat([middle - half, middle + half], dim=2))
        logits.append(logit.flatten(1))
    return torch.cat(boxes, dim=1), torch.cat(logits, dim=1)


def detection_loss(outputs: list[Tensor], truths: list[Float[Tensor, "T 4"]]) -> Float[Tensor, ""]:
    """Of a batch: 5 (1 - IoU^2) of the cells that answer for a fish, and cross entropy of all."""
    boxes, logits = decode(outputs)
    middles, levels = _all_cells(outputs)
    target, box_loss, count = torch.zeros_like(logits), logits.new_zeros(()), 0
    for index, truth in enumerate(truths):
        if not len(truth):
            continue
        owner = _owners(middles, levels, truth)
        [answering] = torch.nonzero(owner >= 0, as_tuple=True)
        iou = _iou(boxes[index, answering], truth[owner[answering]])
        target[index, answering] = iou.detach().clamp(min=_LEAST_SCORE)
        box_loss = box_loss + (1 - iou.square()).sum()
        count += len(answering)
    entropy = binary_cross_entropy_with_logits(logits, target, reduction="sum")
    return (_BOX_WEIGHT * box_loss + entropy) / max(count, 1)


def _owners(
    middles: Float[Tensor, "N 2"], levels: Int[Tensor, "N"], truth: Float[Tensor, "T 4"]
) -> Int[Tensor, "N"]:
    """The fish that each cell answers for, the smallest of several; -1: none."""
    strides = middles.new_tensor(STRIDES)[levels]
    sides = truth[:, 2:] - truth[:, :2]
    size = sides.prod(dim=1).sqrt()
    low, high = middles.new_tensor(_SIZES)[levels].unbind(dim=1)
    offset = (middles[:, None] - (truth[:, :2] + sides / 2)).abs()
    is_near = (offset < _RADIUS * strides[:, None, None]).all(dim=2)
    is_inside = (offset < sides / 2).all(dim=2)
    fits = (size >= low[:, None]) & (size <= high[:, None])
    answers: Bool[Tensor, "N T"] = is_near & is_inside & fits
    # A fish thinner than a cell may have no cell's middle inside: then the nearest one answers.
    distance = torch.where(fits, offset.norm(dim=2), torch.inf)
    answers[distance.argmin(dim=0), torch.arange(len(truth))] = True
    areas = torch.where(answers, sides.prod(dim=1), torch.inf)
    least, owner = areas.min(dim=1)
    return torch.where(least.isfinite(), owner, -1)


def _iou(one: Float[Tensor, "N 4"], other: Float[Tensor, "N 4"]) -> Float[Tensor, "N"]:
    low, high = torch.maximum(one[:, :2], other[:, :2]), torch.minimum(one[:, 2:], other[:, 2:])
    both = (high - low).clamp(min=0).prod(dim=1)
    areas = [(box[:, 2:] - box[:, :2]).prod(dim=1) for box in (one, other)]
    return both / (areas[0] + areas[1] - both + 1e-6)


def _all_cells(outputs: list[Tensor]) -> tuple[Float[Tensor, "N 2"], Int[Tensor, "N"]]:
    middles, levels = [], []
    for level, box in enumerate(outputs[::2]):
        cells = _cells(box.shape[2], box.shape[3])
        middles.append((cells + 0.5) * STRIDES[level])
        levels.append(torch.full((len(cells),), level))
    return torch.cat(middles), torch.cat(levels)


def _cells(height: int, width: int) -> Float[Tensor, "N 2"]:
    """Column and row of every cell."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([columns, rows], dim=2).reshape(-1, 2).float()
