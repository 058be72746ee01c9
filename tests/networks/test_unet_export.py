"""The ONNX model gives what the trained network gives."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from stream_dmr.errors import ModelError
from stream_dmr.networks import unet
from stream_dmr.networks.unet import load_weights, normalise, save_weights
from stream_dmr.segmentation import unet_segmenter
from stream_dmr.segmentation.unet_segmenter import UNetSegmenter
from tests.support.random_unet import random_inputs, random_network, segmenter_of


@torch.no_grad()
@pytest.mark.parametrize("size", [64, 96])
def test_inference_gives_what_the_trained_network_gives(size):
    network = random_network()
    images, boxes = random_inputs(size=size)
    mask_logits, ends_logits = network(
        normalise(torch.from_numpy(images).float(), torch.from_numpy(boxes))
    )
    probability, log_ends = segmenter_of(network).segment_batch(images, boxes)
    np.testing.assert_allclose(probability, torch.sigmoid(mask_logits), atol=1e-4)
    expected = torch.log_softmax(ends_logits.flatten(2), dim=2).numpy()
    np.testing.assert_allclose(log_ends.reshape(expected.shape), expected, rtol=1e-4, atol=1e-4)
    assert any(isinstance(m, torch.nn.BatchNorm2d) for m in network.modules())  # still trainable


def test_weights_to_train_on_from_are_those_that_run():
    images, boxes = random_inputs()
    shipped = UNetSegmenter.load(unet_segmenter.SHIPPED).segment_batch(images, boxes)
    trained = segmenter_of(load_weights(unet.SHIPPED)).segment_batch(images, boxes)
    for one, other in zip(shipped, trained, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)


def test_weights_run_as_they_are(tmp_path):
    save_weights(random_network(), tmp_path / "unet.pt")
    found = UNetSegmenter.load(tmp_path / "unet.pt").segment(
        np.zeros((64, 64, 3), np.uint8), np.array([10.0, 10.0, 50.0, 50.0])
    )
    assert found.probability.shape == (64, 64)


def test_another_model_is_refused(tmp_path):
    (tmp_path / "unet.onnx").write_bytes(b"no model")
    with pytest.raises(ModelError, match="expected an ONNX model"):
        UNetSegmenter.load(tmp_path / "unet.onnx")


def test_a_run_imports_no_torch():
    code = (
        "import sys; from stream_dmr.segmentation.open_segmenter import open_segmenter;"
        "open_segmenter('unet'); sys.exit('torch' in sys.modules or 'onnx' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
