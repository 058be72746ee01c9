"""A U-Net small enough for two CPU cores (paper, Sec. 2; Ronneberger et al., MICCAI 2015).

Its first convolution halves the input, so that no layer works at full size; the last convolution
gives four values per cell, which are the four pixels of that cell. The widths were chosen for 15 ms
a crop on one core: 1.53 million weights, more than half of them in the coarsest level, which takes
little time, need 3.3 ms (docs/research/start-and-memory.md).

A run computes the trained U-Net as an ONNX model, without torch. The graph is written node by node:
PyTorch's exporters need packages of their own, and would leave out `normalise` and the output's
scaling. Batch normalisation is folded into the convolution before it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from jaxtyping import Float, Float32
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle
from torch.nn.utils.fusion import fuse_conv_bn_eval

from stream_dmr.errors import ModelError
from stream_dmr.networks.unet_interface import (
    BOXES_INPUT,
    ENDS_OUTPUT,
    IMAGES_INPUT,
    MASK_OUTPUT,
    MODEL_FORMAT,
    WEIGHTS,
)

_WIDTHS = (24, 40, 64, 96, 128)  # channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the size
_DEPTHS = (0, 1, 1, 2, 2)  # residual blocks on the way down
MIN_SPREAD = 4.0  # grey levels: noise of a uniform image is not amplified


class UNet(nn.Module):
    """From a crop and its box to the fish's mask and the positions of its head and tail."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _convolve(4, _WIDTHS[0], kernel=4, stride=2)
        self.down, self.across, self.up = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for fine, coarse, depth in zip(_WIDTHS, _WIDTHS[1:], _DEPTHS[1:], strict=False):
            blocks = (Residual(coarse) for _ in range(depth))
            self.down.append(nn.Sequential(_convolve(fine, coarse, stride=2), *blocks))
            self.across.append(nn.Conv2d(coarse, fine, 1))
            self.up.append(Residual(fine))
        self.mask = nn.Conv2d(_WIDTHS[0], 4, 3, padding=1)
        self.ends = nn.Conv2d(_WIDTHS[1], 2, 3, padding=1)

    def forward(
        self, inputs: Float[Tensor, "B 4 H W"]
    ) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B 2 h w"]]:
        """Logits of the mask at the input's size, and of head and tail at a quarter of it.

        `inputs` are from `normalise`; h and w are H and W over ENDS_STRIDE.
        """
        x = self.stem(inputs)
        levels = [x]
        for down in self.down:
            levels.append(x := down(x))
        ends = x
        for level in reversed(range(len(self.up))):
            x = interpolate(self.across[level](x), scale_factor=2.0, mode="nearest")
            x = self.up[level](x + levels[level])
            if level == 1:
                ends = self.ends(x)
        return pixel_shuffle(self.mask(x), 2)[:, 0], ends


def normalise(
    images: Float32[Tensor, "B H W 3"], in_box: Float32[Tensor, "B H W"]
) -> Float32[Tensor, "B 4 H W"]:
    """The network's input from BGR images (0 to 255) and the fraction of each pixel in the box.

    Each channel's mean is subtracted and the image's overall spread set to one, so that neither
    the water's colour nor the exposure matters.
    """
    centred = images - images.mean(dim=(1, 2), keepdim=True)
    spread = centred.square().mean(dim=(1, 2, 3), keepdim=True).sqrt()
    channels = torch.cat([centred / (spread + MIN_SPREAD), in_box[..., None] - 0.5], dim=3)
    return channels.permute(0, 3, 1, 2)  # channels_last in memory, the faster layout


class Residual(nn.Module):
    """Two convolutions with a skip connection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _convolve(width, width)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        return torch.relu(x + self.second(self.first(x)))


def _convolve(channels: int, width: int, *, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, batch normalisation, ReLU; an even kernel halves without a shift."""
    padding = (kernel - 1) // 2
    return nn.Sequential(
        nn.Conv2d(channels, width, kernel, stride, padding, bias=False),
        nn.BatchNorm2d(width),
        nn.ReLU(inplace=True),
    )


SHIPPED = WEIGHTS / "unet.pt"


def save_weights(network: UNet, path: Path) -> None:
    """Write the weights in half precision, whose rounding error is 0.05 % at most."""
    state = {
        name: value.half() if value.is_floating_point() else value
        for name, value in network.state_dict().items()
    }
    torch.save({"format": MODEL_FORMAT, "state": state}, path)


def load_weights(path: Path) -> UNet:
    """The network with these weights, in evaluation mode on the CPU.

    Raises ModelError if the file cannot be read or was not written by `save_weights`.
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


_OPSET = 17  # of 2022; onnxruntime 1.20 and later have it
_IR_VERSION = 8  # that belongs to it


def export_unet(network: UNet, path: Path) -> None:
    """Write the network as an ONNX file."""
    path.write_bytes(unet_as_onnx(network))


def unet_as_onnx(network: UNet) -> bytes:
    """The content of an ONNX file.

    Inputs: images (B, H, W, 3), BGR, 0 to 255; box coverages (B, H, W). Outputs: probabilities of
    fish (B, H, W); log probabilities of head and tail (B, 2, H / 4, W / 4).
    """
    graph = _Graph()
    with torch.no_grad():
        mask, ends = _add_network(graph, network.eval(), _add_normalise(graph))
    graph.add(
        "Squeeze", [graph.add("DepthToSpace", [mask], blocksize=2, mode="CRD"), graph.ints(1)]
    )
    graph.add("Sigmoid", [graph.last], name=MASK_OUTPUT)
    flat = graph.add("Reshape", [ends, graph.ints(0, 0, -1)])
    graph.add("Reshape", [graph.add("LogSoftmax", [flat], axis=2), graph.add("Shape", [ends])])
    graph.add("Identity", [graph.last], name=ENDS_OUTPUT)
    return graph.model().SerializeToString()


class _Graph:
    """Nodes and constants of an ONNX graph, as they are added."""

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []
        self.last = ""  # output of the last node

    def add(self, kind: str, inputs: list[str], *, name: str = "", **attributes: Any) -> str:
        """Append a node; returns the name of its output."""
        self.last = name or f"{kind.lower()}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [self.last], **attributes))
        return self.last

    def constant(self, value: np.ndarray) -> str:
        name = f"constant_{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(value, name))
        return name

    def ints(self, *values: int) -> str:
        return self.constant(np.array(values, np.int64))

    def floats(self, *values: float) -> str:
        return self.constant(np.array(values, np.float32))

    def convolve(self, x: str, layer: nn.Module) -> str:
        assert isinstance(layer, nn.Conv2d)
        assert layer.bias is not None
        weights = [self.constant(values.detach().numpy()) for values in (layer.weight, layer.bias)]
        pads = [int(side) for side in layer.padding] * 2
        return self.add("Conv", [x, *weights], pads=pads, strides=list(layer.stride))

    def convolve_relu(self, x: str, block: nn.Module) -> str:
        assert isinstance(block, nn.Sequential)
        convolution, normalisation, _ = block
        assert isinstance(convolution, nn.Conv2d)
        assert isinstance(normalisation, nn.BatchNorm2d)
        return self.add("Relu", [self.convolve(x, fuse_conv_bn_eval(convolution, normalisation))])

    def residual(self, x: str, block: nn.Module) -> str:
        """Append two convolutions with a skip connection."""
        assert isinstance(block, Residual)
        second = self.convolve(self.convolve_relu(x, block.first), block.second)
        return self.add("Relu", [self.add("Add", [x, second])])

    def model(self) -> onnx.ModelProto:
        tensor = helper.make_tensor_value_info
        graph = helper.make_graph(
            self._nodes,
            "unet",
            inputs=[
                tensor(IMAGES_INPUT, TensorProto.UINT8, ["batch", "height", "width", 3]),
                tensor(BOXES_INPUT, TensorProto.FLOAT, ["batch", "height", "width"]),
            ],
            outputs=[
                tensor(MASK_OUTPUT, TensorProto.FLOAT, ["batch", "height", "width"]),
                tensor(ENDS_OUTPUT, TensorProto.FLOAT, ["batch", 2, "rows", "columns"]),
            ],
            initializer=self._constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)])
        model.ir_version = _IR_VERSION
        helper.set_model_props(model, {"format": MODEL_FORMAT})
        return model


def _add_normalise(graph: _Graph) -> str:
    pixels = graph.add("Cast", [IMAGES_INPUT], to=TensorProto.FLOAT)
    centred = graph.add("Sub", [pixels, graph.add("ReduceMean", [pixels], axes=[1, 2])])
    squares = graph.add("Mul", [centred, centred])
    spread = graph.add("Sqrt", [graph.add("ReduceMean", [squares], axes=[1, 2, 3])])
    spread = graph.add("Add", [spread, graph.floats(MIN_SPREAD)])
    colours = graph.add("Div", [centred, spread])
    boxes = graph.add("Sub", [BOXES_INPUT, graph.floats(0.5)])
    boxes = graph.add("Unsqueeze", [boxes, graph.ints(3)])
    channels = graph.add("Concat", [colours, boxes], axis=3)
    return graph.add("Transpose", [channels], perm=[0, 3, 1, 2])


def _add_network(graph: _Graph, network: UNet, x: str) -> tuple[str, str]:
    """`UNet.forward` as nodes: the mask's four logits a cell, and the logits of the ends."""
    twice = graph.floats(1.0, 1.0, 2.0, 2.0)
    x = graph.convolve_relu(x, network.stem)
    levels = [x]
    for down in network.down:
        first, *blocks = down.children()
        x = graph.convolve_relu(x, first)
        for block in blocks:
            x = graph.residual(x, block)
        levels.append(x)
    ends = x
    for level in reversed(range(len(network.up))):
        x = graph.convolve(x, network.across[level])
        nearest = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        x = graph.add("Resize", [x, "", twice], mode="nearest", **nearest)
        x = graph.residual(graph.add("Add", [x, levels[level]]), network.up[level])
        if level == 1:
            ends = graph.convolve(x, network.ends)
    return graph.convolve(x, network.mask), ends
