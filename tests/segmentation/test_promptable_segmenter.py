"""A user's promptable model finds masks to the pixel, or is refused at once."""

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.open_segmenter import open_segmenter
from stream_dmr.segmentation.promptable_segmenter import PromptableSegmenter

SIDE = 64


def model(path, *, prompts, side=SIDE, bias=-5.0, extra=(), weight=10.0):
    """An ONNX file with logits of `weight` x brightness + `bias`, and 0 x its prompts."""
    inputs = [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, side, side])]
    names = []
    for name, shape in prompts.items():
        inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
        names.append(name)
    constants = {"weight": weight, "bias": bias, "nothing": 0.0}
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["grey"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["grey", "weight"], ["scaled"]),
        helper.make_node("Add", ["scaled", "bias"], ["sum0"]),
    ]
    for index, name in enumerate(names):
        nodes += [
            helper.make_node("ReduceMean", [name], [f"mean{index}"], keepdims=0),
            helper.make_node("Mul", [f"mean{index}", "nothing"], [f"zero{index}"]),
            helper.make_node("Add", [f"sum{index}", f"zero{index}"], [f"sum{index + 1}"]),
        ]
    nodes += [helper.make_node("Identity", [f"sum{len(names)}"], ["masks"]), *extra]
    graph = helper.make_graph(
        nodes,
        "test",
        inputs,
        [helper.make_tensor_value_info("masks", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(np.array(v, np.float32), k) for k, v in constants.items()],
    )
    opset = [helper.make_opsetid("", 13)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)
    return path


BOX = {"box": [1, 4]}

SAM = {"point_coords": [1, 1, 2, 2], "point_labels": [1, 1, 2]}


@pytest.mark.parametrize("prompts", [BOX, SAM, {"boxes": [1, 1, 4]}], ids=["box", "sam", "boxes"])
@pytest.mark.parametrize("size", [64, 128, 192])
def test_a_mask_lies_where_the_fish_is_in_the_crop(tmp_path, prompts, size):
    segmenter = open_segmenter(str(model(tmp_path / "bright.onnx", prompts=prompts)))
    image = np.zeros((size, size, 3), np.uint8)
    center = ((size - 1) / 2 + 0.1 * size, 0.45 * size)
    fine = np.zeros((8 * size, 8 * size), np.uint8)
    middle = tuple(round((c + 0.5) * 8 - 0.5) for c in center)
    cv2.ellipse(fine, middle, (round(2.4 * size), round(1.2 * size)), 20, 0, 360, 255, -1)
    image[:] = cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA)[..., None]
    found = segmenter.segment(image, np.array([0.1, 0.2, 0.9, 0.7]) * size)
    mask, truth = found.probability > 0.5, image[..., 0] > 127
    assert (mask & truth).sum() / (mask | truth).sum() > 0.97
    rows, columns = np.nonzero(mask)  # no half pixel is lost on the way
    np.testing.assert_allclose([columns.mean(), rows.mean()], center, atol=0.15)
    assert found.ends is None


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"prompts": {}}, "one for a box"),
        ({"prompts": {"box": [1, 3]}}, "a picture and a box"),
        ({"prompts": {"text": [1, 4]}}, "a picture and a box"),
        ({"prompts": BOX, "side": 16}, "at least 32 px"),
        ({"prompts": BOX, "bias": float("nan")}, "NaN"),
    ],
)
def test_models_of_another_kind_are_refused(tmp_path, changes, complaint):
    path = model(tmp_path / "bad.onnx", **changes)
    with pytest.raises(ModelError, match=complaint) as caught:
        PromptableSegmenter(path)
    assert "\n" not in str(caught.value)
