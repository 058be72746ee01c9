"""A small classifier of species, trained on crops in a second or two, as an ONNX file."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from stream_dmr.messages import FishCrop
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.pipeline.config import load_config
from stream_dmr.sources.open_source import open_source
from stream_dmr.tracking.finder import open_finder

SIDE_PX = 24
_STEPS, _BATCH = 100, 32


def crops_of(scene: Path, *, boxes: str | None = None) -> list[FishCrop]:
    """Every crop of a simulated scene, as a run with its masks cuts them."""
    config = load_config(None)
    finder = open_finder(
        boxes=None if boxes is None else scene / boxes,
        masks=scene / "masks",
        detect=config.detect_fish,
        track=config.track_fish,
    )
    node = CropFish(config.crop_fish, camera=None, finder=finder)
    source = open_source(str(scene / "video.mp4"), config.read_frames)
    try:
        return [crop for frame in source for crop in node.step(frame)]
    finally:
        source.close()


def train_classifier(path: Path, pictures: Mapping[str, Sequence[np.ndarray]]) -> Path:
    """Train on BGR pictures by FAO code, and write the model with these codes in its metadata."""
    torch.manual_seed(0)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # its layers are too small to share
    rng = np.random.default_rng(0)
    codes = list(pictures)
    inputs = np.stack([_input(one) for code in codes for one in pictures[code]])
    classes = np.array([n for n, code in enumerate(codes) for _ in pictures[code]])
    network = _network(len(codes))
    optimiser = torch.optim.Adam(network.parameters(), lr=0.003)
    for _ in range(_STEPS):
        # As many of each class, and turned: a fish hangs any way.
        of_each = [np.flatnonzero(classes == n) for n in range(len(codes))]
        chosen = np.concatenate([rng.choice(one, _BATCH // len(codes)) for one in of_each])
        batch = np.rot90(inputs[chosen], rng.integers(4), axes=(2, 3)).copy()
        loss = nn.functional.cross_entropy(
            network(torch.from_numpy(batch)), torch.from_numpy(classes[chosen])
        )
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    torch.set_num_threads(threads)
    path.write_bytes(_as_onnx(network, codes))
    return path


def _input(picture: np.ndarray) -> np.ndarray:
    small = cv2.resize(picture, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
    return small[..., ::-1].transpose(2, 0, 1).astype(np.float32) / 255


def _network(num_classes: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(3, 8, 3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(2),
        nn.Conv2d(8, 12, 3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(2),
        nn.Flatten(),
        nn.Linear(12 * (SIDE_PX // 4) ** 2, num_classes),
    )


def _as_onnx(network: nn.Sequential, codes: Sequence[str]) -> bytes:
    nodes, constants, last = list[onnx.NodeProto](), list[onnx.TensorProto](), "image"
    for number, layer in enumerate(network):
        names = [last]
        for key, value in layer.named_parameters():
            constants.append(numpy_helper.from_array(value.detach().numpy(), f"{number}.{key}"))
            names.append(f"{number}.{key}")
        last = f"out{number}"
        match layer:
            case nn.Conv2d():
                nodes.append(helper.make_node("Conv", names, [last], pads=[1, 1, 1, 1]))
            case nn.ReLU():
                nodes.append(helper.make_node("Relu", names, [last]))
            case nn.MaxPool2d():
                node = helper.make_node("MaxPool", names, [last], kernel_shape=[2, 2])
                node.attribute.append(helper.make_attribute("strides", [2, 2]))
                nodes.append(node)
            case nn.Flatten():
                nodes.append(helper.make_node("Flatten", names, [last]))
            case _:
                nodes.append(helper.make_node("Gemm", names, [last], transB=1))
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, SIDE_PX, SIDE_PX])
    logits = helper.make_tensor_value_info(last, TensorProto.FLOAT, [1, len(codes)])
    graph = helper.make_graph(nodes, "species", [image], [logits], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {"species": ",".join(codes)})
    return model.SerializeToString()
