"""Training of the detector: its frames, its loss, and the file that a run reads."""

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from benchmarks.segmentation.detector.loss import STRIDES, decode, detection_loss
from benchmarks.segmentation.detector.onnx_module import OnnxModule
from benchmarks.segmentation.detector.training_frames import (
    SIDE_PX,
    AnnotatedFrame,
    FrameSource,
)
from benchmarks.segmentation.empty_squares import largest_empty_square
from stream_dmr.training.image_degradation import make_bank

boxes_of_any_place = st.lists(
    st.tuples(st.integers(-20, 120), st.integers(-20, 90), st.integers(3, 60), st.integers(3, 60)),
    max_size=4,
)


@given(boxes_of_any_place)
@settings(deadline=None)
def test_an_empty_square_shows_nothing_of_a_box(places):
    image = np.zeros((90, 120, 3), np.uint8)
    boxes = [np.array([x, y, x + w, y + h], np.float64) for x, y, w, h in places]
    for x0, y0, x1, y1 in np.clip(boxes, 0, None).astype(int) if boxes else []:
        image[y0:y1, x0:x1] = 255
    square = largest_empty_square(image, boxes)
    if square is None:
        assert boxes
    else:
        assert square.shape[0] == square.shape[1] >= 0.35 * 90 - 2
        assert not square.any()


def outputs_for(fish: np.ndarray, *, logit: float) -> list[torch.Tensor]:
    """Outputs whose cells all have this one box; those within it have the logit."""
    found = []
    for stride in STRIDES:
        side = SIDE_PX // stride
        rows, columns = np.mgrid[:side, :side]
        middle, size = (fish[:2] + fish[2:]) / 2, fish[2:] - fish[:2]
        offset = middle[:, None, None] / stride - np.stack([columns, rows])
        log_size = np.broadcast_to(np.log(size / stride)[:, None, None], offset.shape)
        found.append(torch.tensor(np.concatenate([offset, log_size])[None]).float())
        found.append(torch.full((1, 1, side, side), logit))
    return found


def test_cells_have_boxes_in_pixels():
    fish = np.array([50.0, 60.0, 130.0, 100.0])
    boxes, logits = decode(outputs_for(fish, logit=-3.0))
    assert boxes.shape[:2] == logits.shape
    np.testing.assert_allclose(boxes[0], np.tile(fish, (boxes.shape[1], 1)), atol=1e-3)


def test_the_right_box_costs_least_and_every_fish_asks_for_a_cell():
    fish = np.array([50.0, 60.0, 130.0, 100.0])
    truth = torch.tensor(fish[None]).float()
    right = detection_loss(outputs_for(fish, logit=-6.0), [truth])
    for change in ([10, 0, 10, 0], [0, 0, 30, 0], [30, 30, 90, 70]):
        other = fish + np.array(change)
        assert detection_loss(outputs_for(other, logit=-6.0), [truth]) > right + 0.3
    thin = torch.tensor([[100.0, 100.0, 103.0, 101.0]])
    outputs = [one.requires_grad_() for one in outputs_for(fish, logit=-6.0)]
    detection_loss(outputs, [thin]).backward()
    assert sum(int((one.grad < 0).sum()) for one in outputs[1::2]) >= 1  # a score should rise


def test_frames_have_boxes_within_them():
    bank = make_bank(num_fish=4, num_backgrounds=2, seed=3, progress=lambda: None)
    picture = np.full((100, 160, 3), 90, np.uint8)
    frame = AnnotatedFrame(picture, np.array([[20.0, 30.0, 90.0, 60.0]]))
    empty = AnnotatedFrame(picture, np.zeros((0, 4)))
    source = FrameSource([[frame, frame, empty, frame], [frame]], [frame], bank)
    num_boxes = 0
    for seed in range(30):
        image, boxes = source(np.random.default_rng(seed))
        assert image.shape == (SIDE_PX, SIDE_PX, 3)
        assert image.dtype == np.uint8
        assert (boxes >= 0).all()
        assert (boxes <= SIDE_PX).all()
        assert (boxes[:, 2:] > boxes[:, :2]).all()
        num_boxes += len(boxes)
    assert num_boxes > 20


def test_a_module_computes_what_the_file_computes(tmp_path):
    rng = np.random.default_rng(0)
    constants = {
        "w": rng.normal(size=(4, 6, 3, 3)).astype(np.float32),
        "b": rng.normal(size=4).astype(np.float32),
        "start": np.array([0, 1]),
        "end": np.array([99, 99]),
        "axes": np.array([2, 3]),
        "steps": np.array([2, 2]),
        "scales": np.array([1, 1, 2, 2], np.float32),
    }
    node = helper.make_node
    nodes = [
        node("Slice", ["images", "start", "end", "axes", "steps"], ["odd"]),
        node("Concat", ["odd", "odd"], ["both"], axis=1),
        node("Conv", ["both", "w", "b"], ["c"], pads=[1] * 4, strides=[1, 1], group=1),
        node("Sigmoid", ["c"], ["s"]),
        node("Mul", ["c", "s"], ["m"]),
        node("MaxPool", ["m"], ["p"], kernel_shape=[5, 5], strides=[1, 1], pads=[2] * 4),
        node("Add", ["p", "m"], ["a"]),
        node(
            "Resize",
            ["a", "", "scales"],
            ["out"],
            mode="nearest",
            coordinate_transformation_mode="asymmetric",
            nearest_mode="floor",
        ),
    ]
    shape = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "test",
        [shape("images", TensorProto.FLOAT, [1, 3, 16, 16])],
        [shape("out", TensorProto.FLOAT, [1, 4, "h", "w"])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, tmp_path / "small.onnx")
    images = rng.normal(size=(1, 3, 16, 16)).astype(np.float32)
    [expected] = onnxruntime.InferenceSession(str(tmp_path / "small.onnx")).run(
        None, {"images": images}
    )
    module = OnnxModule(tmp_path / "small.onnx", ["m", "out"])
    assert sum(weight.numel() for weight in module.parameters()) == 4 * 6 * 9 + 4
    half, whole = module(torch.from_numpy(images))
    assert half.shape[-1] == expected.shape[-1] // 2
    assert whole.detach().numpy() == pytest.approx(expected, abs=1e-5)
