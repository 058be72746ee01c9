"""Losses are least at the truth, and unknown ends do not count."""

import numpy as np
import pytest
import torch

from stream_dmr.networks.unet_interface import ENDS_STRIDE
from stream_dmr.training.unet_trainer import ends_are_right, ends_loss, mask_iou, mask_loss
from tests.support.random_unet import log_blob


def test_losses_are_least_at_the_truth():
    masks = torch.zeros(2, 64, 64)
    masks[:, 20:40, 10:50] = 1
    right, wrong = 20 * masks - 10, 20 * masks.roll(5, dims=1) - 10
    assert mask_loss(right, masks) < 0.01 < mask_loss(wrong, masks)
    torch.testing.assert_close(mask_iou(right, masks), torch.ones(2))
    assert mask_iou(wrong, masks)[0] == pytest.approx(15 / 25)
    ends = torch.tensor([[[10.0, 20.0], [50.0, 40.0]]])
    logits = torch.from_numpy(
        np.stack([log_blob(16, *((end.numpy() + 0.5) / ENDS_STRIDE - 0.5)) for end in ends[0]])
    )[None]
    best = float(ends_loss(logits, ends))
    assert best < float(ends_loss(logits.flip(1), ends))
    assert best < float(ends_loss(torch.zeros_like(logits), ends))
    assert ends_are_right(logits, ends)[0].all()
    assert not ends_are_right(logits.flip(1), ends)[0].any()


def test_a_missing_thin_tail_costs_more_than_as_much_of_the_body():
    masks = torch.zeros(1, 32, 32)
    masks[:, 10:22, 4:20] = 1.0
    masks[:, 15:17, 20:28] = 1.0  # 16 pixels
    logits = 20 * masks - 10
    no_tail, no_flank = logits.clone(), logits.clone()
    no_tail[:, 15:17, 20:28] = -10
    no_flank[:, 10, 4:20] = -10
    assert mask_loss(no_tail, masks) > 2 * mask_loss(no_flank, masks)


def test_unknown_ends_have_no_gradient():
    logits = torch.randn(3, 2, 16, 16, requires_grad=True)
    ends_px = torch.full((3, 2, 2), float("nan"))
    ends_px[2] = 1000.0  # outside
    loss = ends_loss(logits, ends_px)
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert not logits.grad.any()
    assert not ends_are_right(logits, ends_px)[1][:2].any()
