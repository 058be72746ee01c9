"""The trained U-Net as an ONNX model, which a run computes without torch.

The graph is written node by node: PyTorch's exporters need packages of their own, and would not
take `normalise` and the output's scaling along. Batch normalisation is folded into the convolution
before it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from stream_dmr.segmentation.network.unet import MIN_SPREAD, Residual, UNet
from stream_dmr.segmentation.network.unet_interface import (
    BOXES_INPUT,
    ENDS_OUTPUT,
    IMAGES_INPUT,
    MASK_OUTPUT,
    MODEL_FORMAT,
)

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
        """The name of a constant."""
        name = f"constant_{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(value, name))
        return name

    def ints(self, *values: int) -> str:
        """The name of a constant vector of integers."""
        return self.constant(np.array(values, np.int64))

    def floats(self, *values: float) -> str:
        """The name of a constant vector."""
        return self.constant(np.array(values, np.float32))

    def convolve(self, x: str, layer: nn.Module) -> str:
        """Append a convolution with bias."""
        assert isinstance(layer, nn.Conv2d)
        assert layer.bias is not None
        weights = [self.constant(one.detach().numpy()) for one in (layer.weight, layer.bias)]
        pads = [int(side) for side in layer.padding] * 2
        return self.add("Conv", [x, *weights], pads=pads, strides=list(layer.stride))

    def convolve_relu(self, x: str, block: nn.Module) -> str:
        """Append a convolution with batch normalisation and ReLU."""
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
        """The whole model with its inputs and outputs."""
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
    """`unet.normalise` as nodes."""
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
