"""The network's weights as a file to train on from: the shipped ones, and a user's."""

from pathlib import Path

import torch

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.network.unet import UNet
from stream_dmr.segmentation.network.unet_interface import MODEL_FORMAT

SHIPPED = Path(__file__).parent / "weights" / "unet.pt"


def save_weights(network: UNet, path: Path) -> None:
    """Write the weights in half precision, whose rounding error is 0.05 % at most."""
    state = {
        name: value.half() if value.is_floating_point() else value
        for name, value in network.state_dict().items()
    }
    torch.save({"format": MODEL_FORMAT, "state": state}, path)


def load_weights(path: Path) -> UNet:
    """The network with these weights, in evaluation mode on the CPU.

    Raises ModelError where the file cannot be read or is not one that `save_weights` wrote.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ModelError(
            f"{path}: expected the weights of a U-Net, got: {error.strerror}"
        ) from error
    except Exception as error:  # torch raises errors of many kinds for foreign bytes
        raise ModelError(
            f"{path}: expected weights written by `stream-dmr train`, got another kind of file"
        ) from error
    if not isinstance(content, dict) or content.get("format") != MODEL_FORMAT:
        raise ModelError(
            f"{path}: expected weights in the format '{MODEL_FORMAT}', got others; train them again"
        )
    network = UNet()
    try:
        state = {
            name: value.float() if value.is_floating_point() else value
            for name, value in content["state"].items()
        }
        network.load_state_dict(state)
    except Exception as error:  # keys or shapes of another network, or no tensors at all
        raise ModelError(
            f"{path}: expected the layers of this version's network, got others; train them again"
        ) from error
    if not all(bool(value.isfinite().all()) for value in state.values()):
        raise ModelError(f"{path}: expected finite weights, got NaN or infinity; train them again")
    return network.eval()
