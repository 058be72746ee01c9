"""A network with random weights, and inputs and output maps for it."""

from pathlib import Path

import numpy as np
import torch

from stream_dmr.networks.onnx_session import open_session
from stream_dmr.networks.unet import UNet, unet_as_onnx
from stream_dmr.segmentation.unet_segmenter import UNetSegmenter


def random_network(seed: int = 0) -> UNet:
    torch.manual_seed(seed)
    network = UNet()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_()
            module.running_var.uniform_(0.5, 2.0)
    return network.eval()


def segmenter_of(network: UNet) -> UNetSegmenter:
    """The network as a run computes it."""
    return UNetSegmenter(open_session(Path("unet.onnx"), content=unet_as_onnx(network)))


def random_inputs(
    seed: int = 0, *, batch: int = 2, size: int = 64
) -> tuple[np.ndarray, np.ndarray]:
    """Images and coverages by their boxes."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (batch, size, size, 3), np.uint8)
    return images, rng.random((batch, size, size), np.float32)


def log_blob(size: int, x: float, y: float) -> np.ndarray:
    """Log probabilities of a Gaussian of one cell around (x, y)."""
    rows, columns = np.mgrid[:size, :size]
    weights = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 2) + 1e-9
    return np.log(weights / weights.sum()).astype(np.float32)
