"""The trained detector as an ONNX file that `OnnxDetector` reads."""

from pathlib import Path

import numpy as np
import onnx
import torch
from jaxtyping import Float32
from onnx import TensorProto, helper, numpy_helper

from benchmarks.segmentation.detector.loss import STRIDES
from benchmarks.segmentation.detector.onnx_module import OnnxModule, weight_key

OUTPUTS = ["1062", "1063", "1104", "1105", "1146", "1147"]  # YOLOX's boxes and scores, by level
SIZE_PX = (512, 384)  # width and height of its input
_OPSET, _IR_VERSION = 17, 8


def export_detector(network: OnnxModule, path: Path) -> None:
    """Write it: input (1, 3, h, w), RGB from 0 to 1; output (1, N, 6), layout "yolov5".

    YOLOX takes BGR from 0 to 255: its first convolution's weights are changed to that.
    """
    state = {name: value.detach().numpy() for name, value in network.weights.items()}
    names = [name for node in network.nodes if node.op_type == "Conv" for name in node.input[1:]]
    weights = {name: state[weight_key(name)] for name in dict.fromkeys(names)}
    weights[names[0]] = 255 * _other_channels(weights[names[0]])
    others = {
        name: network.constants[name]
        for node in network.nodes
        for name in node.input
        if name in network.constants and name not in weights
    }
    constants = [
        numpy_helper.from_array(np.ascontiguousarray(value), name)
        for name, value in {**weights, **others}.items()
    ]
    decoding = _decoding()
    graph = helper.make_graph(
        [*network.nodes, *decoding[0]],
        "fish",
        inputs=[helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, *SIZE_PX[::-1]])],
        outputs=[helper.make_tensor_value_info("boxes", TensorProto.FLOAT, [1, "n", 6])],
        initializer=[*constants, *decoding[1]],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)])
    model.ir_version = _IR_VERSION
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())


def go_on_from(network: OnnxModule, path: Path) -> None:
    """Set the network's weights to those of a file by `export_detector`."""
    stored = {one.name: numpy_helper.to_array(one) for one in onnx.load(path).graph.initializer}
    convolutions = [node for node in network.nodes if node.op_type == "Conv"]
    first = convolutions[0].input[1]
    stored[first] = _other_channels(stored[first]) / 255
    with torch.no_grad():
        for name in (name for node in convolutions for name in node.input[1:]):
            network.weights[weight_key(name)].copy_(torch.tensor(stored[name]))


def _other_channels(weight: Float32[np.ndarray, "C 12 h w"]) -> Float32[np.ndarray, "C 12 h w"]:
    """Of the first convolution, which takes the colours of four pixels: BGR for RGB, or back."""
    return weight.reshape(-1, 4, 3, *weight.shape[2:])[:, :, ::-1].reshape(weight.shape)


def _decoding() -> tuple[list[onnx.NodeProto], list[onnx.TensorProto]]:
    """Nodes and constants from cells to middles and sizes in px, scores, and ones."""
    nodes, constants = [], [numpy_helper.from_array(np.array([0, 0, -1]), "flat")]
    parts = []
    for level, stride in enumerate(STRIDES):
        width, height = (side // stride for side in SIZE_PX)
        rows, columns = np.mgrid[:height, :width]
        cells = stride * np.stack([columns, rows]).reshape(1, 2, -1).astype(np.float32)
        values = {
            "cells": cells,
            "stride": np.array([stride], np.float32),
            "ones": np.ones((1, 1, cells.shape[2]), np.float32),
            "halves": np.array([2, 2]),
        }
        constants += [numpy_helper.from_array(v, f"{k}_{level}") for k, v in values.items()]

        def add(
            kind: str, inputs: list[str], outputs: list[str], *, level: int = level, **given: int
        ) -> None:
            numbered = [
                name if name[0].isdigit() or name == "flat" else f"{name}_{level}"
                for name in inputs
            ]
            named = [f"{name}_{level}" for name in outputs]
            nodes.append(helper.make_node(kind, numbered, named, **given))

        add("Reshape", [OUTPUTS[2 * level], "flat"], ["box"])
        add("Split", ["box", "halves"], ["middle", "size"], axis=1)
        add("Mul", ["middle", "stride"], ["offset"])
        add("Add", ["offset", "cells"], ["place"])
        add("Exp", ["size"], ["ratio"])
        add("Mul", ["ratio", "stride"], ["sides"])
        add("Reshape", [OUTPUTS[2 * level + 1], "flat"], ["logit"])
        add("Sigmoid", ["logit"], ["score"])
        add("Concat", ["place", "sides", "score", "ones"], ["level"], axis=1)
        parts.append(f"level_{level}")
    nodes.append(helper.make_node("Concat", parts, ["all"], axis=2))
    nodes.append(helper.make_node("Transpose", ["all"], ["boxes"], perm=[0, 2, 1]))
    return nodes, constants
