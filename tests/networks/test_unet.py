"""The network's shapes, and its indifference to colour casts."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.networks.unet import UNet, normalise
from stream_dmr.networks.unet_interface import ENDS_STRIDE
from tests.support.random_unet import random_inputs


@torch.no_grad()
def test_masks_have_the_size_of_the_input_and_ends_a_quarter_of_it():
    images, boxes = random_inputs(size=96)
    mask, ends = UNet().eval()(normalise(torch.from_numpy(images).float(), torch.from_numpy(boxes)))
    assert mask.shape == (2, 96, 96)
    assert ends.shape == (2, 2, 96 // ENDS_STRIDE, 96 // ENDS_STRIDE)


@given(st.floats(-80, 80), st.floats(-80, 80), st.floats(-80, 80))
@settings(max_examples=10, deadline=None)
def test_a_colour_cast_changes_no_input(blue, green, red):
    images, boxes = random_inputs()
    pictures = torch.from_numpy(images).float()
    cast = torch.tensor([blue, green, red])
    one, other = (normalise(p, torch.from_numpy(boxes)) for p in (pictures, pictures + cast))
    torch.testing.assert_close(one, other, rtol=0, atol=1e-3)
