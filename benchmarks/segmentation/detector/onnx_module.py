"""An ONNX model of convolutions as a torch module: to train on, and to write again."""

from pathlib import Path

import onnx
import torch
from jaxtyping import Float
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn.functional import conv2d, interpolate, max_pool2d


class OnnxModule(nn.Module):
    """Computes some tensors of a model; its convolutions' weights are parameters."""

    def __init__(self, path: Path, outputs: list[str]) -> None:
        """`outputs`: names of the tensors, in order. What they don't depend on is left out."""
        super().__init__()
        graph = onnx.load(path).graph
        self._outputs = outputs
        self._input = graph.input[0].name
        self.constants = {one.name: numpy_helper.to_array(one) for one in graph.initializer}
        wanted, nodes = set(outputs), []
        for node in reversed(graph.node):
            if node.output[0] in wanted:
                wanted |= set(node.input)
                nodes.append(node)
        self.nodes = nodes[::-1]
        self.weights = nn.ParameterDict()
        for node in self.nodes:
            for name in node.input[1:] if node.op_type == "Conv" else []:
                self.weights[weight_key(name)] = nn.Parameter(torch.tensor(self.constants[name]))

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """The values of the outputs."""
        values = {self._input: images}
        for node in self.nodes:
            values[node.output[0]] = self._compute(node, values)
        return [values[name] for name in self._outputs]

    def _compute(self, node: onnx.NodeProto, values: dict[str, Tensor]) -> Tensor:
        given = {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute}
        if node.op_type == "Conv":
            weight, bias = (self.weights[weight_key(name)] for name in node.input[1:])
            x = values[node.input[0]]
            pads = given["pads"][:2]
            return conv2d(x, weight, bias, given["strides"], pads, groups=given["group"])
        if node.op_type == "Slice":
            starts, ends, axes, steps = (self.constants[name] for name in node.input[1:])
            index = [slice(None)] * 4
            for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
                index[axis] = slice(int(start), int(end), int(step))
            return values[node.input[0]][tuple(index)]
        parts = [values[name] for name in node.input if name in values]
        if node.op_type == "Sigmoid":
            return parts[0].sigmoid()
        if node.op_type == "Mul":
            return parts[0] * parts[1]
        if node.op_type == "Add":
            return parts[0] + parts[1]
        if node.op_type == "Concat":
            return torch.cat(parts, dim=given["axis"])
        if node.op_type == "MaxPool":
            side = given["kernel_shape"][0]
            return max_pool2d(parts[0], side, stride=1, padding=side // 2)
        if node.op_type == "Resize":
            return interpolate(parts[0], scale_factor=2.0, mode="nearest")
        raise ValueError(f"expected a node of a known kind, got {node.op_type}")


def weight_key(name: str) -> str:
    """The name of a convolution's constant among the module's parameters."""
    return name.replace(".", "_")
