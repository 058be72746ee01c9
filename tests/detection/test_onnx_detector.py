"""A user's ONNX detector: boxes come back to the frame exactly, and bad models are refused."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from stream_dmr.detection.network_detectors import Letterbox, OnnxDetector, OnnxSettings
from stream_dmr.detection.onnx_outputs import Layout
from stream_dmr.detection.open_detector import DetectFishSettings, open_detector
from stream_dmr.errors import ModelError
from stream_dmr.geometry import whole_pixels
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.segmentation.crop import CropFishSettings
from stream_dmr.tracking.finder import TrackedFish, TrackFishSettings

INPUT = 320

SCORE = 0.9


def write_model(
    path: Path,
    outputs: Sequence[np.ndarray],
    *,
    shape: Sequence[int | str] = (1, 3, INPUT, INPUT),
    kind: int = TensorProto.FLOAT,
    num_inputs: int = 1,
) -> Path:
    """A model that gives the same outputs whatever it sees, but has to see it."""
    inputs = [helper.make_tensor_value_info(f"in{i}", kind, shape) for i in range(num_inputs)]
    nodes, infos, values = [], [], []
    nodes.append(helper.make_node("Cast", ["in0"], ["seen"], to=TensorProto.FLOAT))
    nodes.append(helper.make_node("ReduceMean", ["seen"], ["mean"], keepdims=0))
    values.append(numpy_helper.from_array(np.zeros((), np.float32), "zero"))
    nodes.append(helper.make_node("Mul", ["mean", "zero"], ["nothing"]))
    for i, output in enumerate(outputs):
        values.append(numpy_helper.from_array(output.astype(np.float32), f"value{i}"))
        nodes.append(helper.make_node("Add", [f"value{i}", "nothing"], [f"out{i}"]))
        infos.append(helper.make_tensor_value_info(f"out{i}", TensorProto.FLOAT, output.shape))
    graph = helper.make_graph(nodes, "fixed", inputs, infos, values)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(path))
    return path


def frame_of(width: int, height: int) -> Frame:
    image = np.zeros((height, width, 3), np.uint8)
    return Frame(frame_index=1, timestamp_ns=0, image=image, source="test")


def to_input(letterbox: Letterbox, boxes: np.ndarray) -> np.ndarray:
    """Boxes of the frame as boxes of the input: where a detector sees them."""
    return boxes * np.tile(letterbox.scale, 2) + np.tile(letterbox.offset, 2)


def middle_and_size(box: np.ndarray) -> np.ndarray:
    return np.concatenate([(box[:2] + box[2:]) / 2, box[2:] - box[:2]])


def outputs_of(layout: str, boxes: np.ndarray) -> list[np.ndarray]:
    """What a detector of that family would put out for boxes (input px), of class 1 of 2."""
    count = len(boxes)
    middles = np.array([middle_and_size(box) for box in boxes])
    scores = np.tile([0.05, SCORE], (count, 1))
    odds = np.log(scores / (1 - scores))
    nothing = np.log(1 - scores.sum(axis=1, keepdims=True))
    rows = {
        "yolo": [np.hstack([middles, scores]).T],
        "yolov5": [np.hstack([middles, np.ones((count, 1)), scores])],
        "yolo-nms": [np.hstack([boxes, scores[:, 1:], np.ones((count, 1))])],
        "detr": [np.hstack([np.log(scores), nothing]), middles / INPUT],
        "rt-detr": [middles / INPUT, odds],
    }[layout]
    return [row[None] for row in rows]


@pytest.mark.parametrize("layout", ["yolo", "yolov5", "yolo-nms", "detr", "rt-detr"])
@pytest.mark.parametrize("size", [(640, 480), (300, 1000), (1280, 960)])
def test_every_family_gives_the_box_in_the_frame(tmp_path, layout: str, size: tuple[int, int]):
    letterbox = Letterbox.from_sizes(frame_size=size, input_size=(INPUT, INPUT))
    truth = np.array([[30.0, 50.0, 130.0, 210.0], [150.5, 220.25, 290.75, 300.5]])
    filling = np.array([[0.0, 0.0, 0.5, 0.5]] * 40)  # padding, too small for a fish
    boxes = to_input(letterbox, np.concatenate([truth, filling]))
    model = write_model(tmp_path / "model.onnx", outputs_of(layout, boxes))
    detector = open_detector(DetectFishSettings(detector=str(model), onnx_layout=layout))
    found = sorted(detector.find(frame_of(*size)), key=lambda c: c.bbox_xyxy_px[0])
    assert [c.score for c in found] == pytest.approx([SCORE, SCORE], abs=1e-6)
    for candidate, box in zip(found, truth, strict=True):
        np.testing.assert_allclose(candidate.bbox_xyxy_px, box, atol=1e-3)


def yolo_model(path: Path, boxes: np.ndarray, **knobs) -> Path:
    filled = np.concatenate([boxes, np.tile([[0.0, 0.0, 0.1, 0.1]], (40, 1))])
    return write_model(path, outputs_of("yolo", filled), **knobs)


def test_overlapping_boxes_and_other_classes_are_removed(tmp_path):
    boxes = np.array([[10.0, 10, 110, 60], [12.0, 11, 112, 62], [200.0, 200, 260, 240]])
    model = yolo_model(tmp_path / "model.onnx", boxes)
    assert len(OnnxDetector(model, OnnxSettings()).find(frame_of(320, 320))) == 2
    assert len(OnnxDetector(model, OnnxSettings(onnx_overlap=1.0)).find(frame_of(320, 320))) == 3
    other = OnnxDetector(model, OnnxSettings(onnx_classes=[0])).find(frame_of(320, 320))
    assert all(candidate.score < 0.1 for candidate in other)


def test_a_model_of_any_size_takes_the_configured_one(tmp_path):
    box = np.array([[16.0, 16, 80, 48]])
    model = yolo_model(tmp_path / "any.onnx", box, shape=("batch", 3, "height", "width"))
    detector = OnnxDetector(model, OnnxSettings(onnx_input_px=160))
    [candidate] = detector.find(frame_of(320, 320))
    np.testing.assert_allclose(candidate.bbox_xyxy_px, box[0] * 2, atol=1e-3)


def test_the_picture_reaches_the_model_in_rgb_from_0_to_1(tmp_path):
    """The model's box is as wide as its input is red: it sees what it should."""
    nodes = [
        helper.make_node("ReduceMean", ["in0"], ["colours"], axes=[2, 3], keepdims=0),  # (1, 3)
        helper.make_node("Gather", ["colours", "first"], ["red"], axis=1),  # (1,)
        helper.make_node("Mul", ["scale", "red"], ["scaled"]),
        helper.make_node("Add", ["base", "scaled"], ["out"]),
    ]
    base, scale = np.zeros((1, 5, 40), np.float32), np.zeros((1, 5, 40), np.float32)
    base[0, :, 0] = [32, 32, 0, 20, 0.9]
    scale[0, 2, 0] = 64
    values = [
        numpy_helper.from_array(np.array(0), "first"),
        numpy_helper.from_array(base, "base"),
        numpy_helper.from_array(scale, "scale"),
    ]
    graph = helper.make_graph(
        nodes,
        "red",
        [helper.make_tensor_value_info("in0", TensorProto.FLOAT, (1, 3, 64, 64))],
        [helper.make_tensor_value_info("out", TensorProto.FLOAT, (1, 5, 40))],
        values,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(tmp_path / "red.onnx"))
    detector = OnnxDetector(tmp_path / "red.onnx", OnnxSettings())
    image = np.zeros((64, 64, 3), np.uint8)
    image[..., 2] = 102  # red, 0.4 of 255
    image[..., 0] = 255
    [found] = detector.find(Frame(frame_index=1, timestamp_ns=0, image=image, source=""))
    x0, _, x1, _ = found.bbox_xyxy_px
    assert x1 - x0 == pytest.approx(0.4 * 64, abs=1e-3)


def refusal(path: Path, **knobs) -> str:
    with pytest.raises(ModelError) as caught:
        OnnxDetector(path, OnnxSettings(**knobs))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    return str(caught.value)


def test_files_that_are_no_models_are_refused(tmp_path):
    assert "found none" in refusal(tmp_path / "missing.onnx")
    (tmp_path / "text.onnx").write_text("not a model")
    assert "can't be loaded" in refusal(tmp_path / "text.onnx")
    (tmp_path / "empty.onnx").touch()
    assert "can't be loaded" in refusal(tmp_path / "empty.onnx")
    cv2.imwrite(str(tmp_path / "picture.png"), np.zeros((4, 4), np.uint8))
    whole = yolo_model(tmp_path / "whole.onnx", np.ones((1, 4))).read_bytes()
    (tmp_path / "torn.onnx").write_bytes(whole[: len(whole) // 2])
    assert "can't be loaded" in refusal(tmp_path / "torn.onnx")


@pytest.mark.parametrize(
    "knobs",
    [
        {"shape": (1, 1, INPUT, INPUT)},
        {"shape": (1, INPUT, INPUT, 3)},
        {"shape": (4, 3, INPUT, INPUT)},
        {"shape": (3, INPUT, INPUT)},
        {"shape": (1, 3, 8, 8)},
        {"kind": TensorProto.UINT8},
        {"num_inputs": 2},
    ],
)
def test_models_that_take_no_picture_are_refused(tmp_path, knobs):
    model = yolo_model(tmp_path / "model.onnx", np.ones((1, 4)), **knobs)
    assert "expected one float input of shape (1, 3, height, width), got in0" in refusal(model)


@pytest.mark.parametrize(
    ("outputs", "layout", "expected"),
    [
        ([np.ones((1, 6, 9))] * 2, "yolo", "expected 1 outputs, got 2"),
        ([np.ones((1, 6, 9))], "detr", "expected 2 outputs, got 1"),
        ([np.zeros((1, 9, 6))], "yolo", "more boxes than classes, got (1, 9, 6)"),
        ([np.zeros((1, 6, 9))], "yolov5", "more boxes than classes, got (1, 6, 9)"),
        ([np.zeros((1, 4, 9))], "yolo", "(1, 4 + classes, boxes), got (1, 4, 9)"),
        ([np.zeros((6, 9))], "yolo", "got (6, 9)"),
        ([np.zeros((1, 9, 5))], "yolov5", "(1, boxes, 5 + classes), got"),
        ([np.zeros((1, 9, 7))], "yolo-nms", "(1, boxes, 6), got"),
        ([np.zeros((1, 9, 5)), np.zeros((1, 9, 3))], "detr", "(1, boxes, 4) and"),
        ([np.zeros((1, 9, 4)), np.zeros((1, 8, 3))], "rt-detr", "(1, boxes, 4) and"),
        ([np.full((1, 6, 9), np.nan)], "yolo", "expected finite boxes and scores, got NaN"),
        ([np.full((1, 6, 9), np.inf)], "yolo", "expected finite boxes and scores"),
        ([np.full((1, 6, 9), 7.0)], "yolo", "expected scores from 0 to 1, got 7 to 7"),
    ],
)
def test_impossible_outputs_are_refused_before_the_first_frame(
    tmp_path, outputs: list[np.ndarray], layout: str, expected: str
):
    model = write_model(tmp_path / "model.onnx", outputs)
    assert expected in refusal(model, onnx_layout=layout)


def test_classes_that_the_model_does_not_have_are_refused(tmp_path):
    model = yolo_model(tmp_path / "model.onnx", np.ones((1, 4)))
    assert "with class 80, which onnx_classes names" in refusal(model, onnx_classes=[0, 80])
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        OnnxSettings(onnx_classes=[-1])


GRID = 80  # cells of a mask of the whole input


def mask_outputs(layout: str, boxes: np.ndarray) -> list[np.ndarray]:
    """Elliptic masks that fill the boxes (input px), as a model of that family puts them out."""
    middle = (np.arange(GRID) + 0.5) * INPUT / GRID
    center, half = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2
    x, y = ((middle - center[:, i : i + 1]) / half[:, i : i + 1] for i in (0, 1))
    logits = (20 * (1 - np.hypot(x[:, None, :], y[:, :, None]))).clip(-50)
    match layout:
        case "yolo-seg":
            (rows,) = outputs_of("yolo", boxes)
            weights = np.eye(len(boxes))[None]  # each mask is a picture of its own
            return [np.concatenate([rows, weights], axis=1), logits[None]]
        case "rf-detr-seg":
            return [*outputs_of("rt-detr", boxes), logits[None]]
    probability = 1 / (1 + np.exp(-logits))
    return [boxes, np.ones(len(boxes)), np.full(len(boxes), SCORE), probability[:, None]]


@pytest.mark.parametrize("layout", ["yolo-seg", "rf-detr-seg", "mask-rcnn"])
@pytest.mark.parametrize("size", [(640, 480), (300, 1000)])
def test_every_family_of_masks_gives_the_silhouette_in_the_frame(
    tmp_path: Path, layout: Layout, size: tuple[int, int]
):
    letterbox = Letterbox.from_sizes(frame_size=size, input_size=(INPUT, INPUT))
    truth = np.array([[30.0, 50.0, 130.0, 210.0], [150.5, 220.25, 290.75, 300.5]])
    filling = np.array([[0.0, 0.0, 0.5, 0.5]] * 40)
    boxes = to_input(letterbox, np.concatenate([truth, filling]))
    model = write_model(tmp_path / "model.onnx", mask_outputs(layout, boxes))
    settings = DetectFishSettings(detector=str(model), onnx_layout=layout)
    found = sorted(open_detector(settings).find(frame_of(*size)), key=lambda c: c.bbox_xyxy_px[0])
    assert len(found) == 2
    for candidate, (x0, y0, x1, y1) in zip(found, truth, strict=True):
        left, top, right, bottom = whole_pixels(candidate.bbox_xyxy_px)
        x, y = np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5
        a, b = (x - (x0 + x1) / 2) / (x1 - x0) * 2, (y - (y0 + y1) / 2) / (y1 - y0) * 2
        ellipse = np.hypot(a[None, :], b[:, None]) < 1
        assert candidate.foreground is not None
        both = np.count_nonzero(candidate.foreground & ellipse)
        assert both / np.count_nonzero(candidate.foreground | ellipse) > 0.95


def test_the_fish_of_a_model_with_masks_need_no_segmenter(tmp_path: Path):
    box = np.array([[60.0, 100, 220, 160]])
    filled = np.concatenate([box, np.tile([[0.0, 0.0, 0.1, 0.1]], (40, 1))])
    model = write_model(tmp_path / "model.onnx", mask_outputs("yolo-seg", filled))
    settings = DetectFishSettings(detector=str(model), onnx_layout="yolo-seg")
    finder = TrackedFish(open_detector(settings), TrackFishSettings(min_track_frames=1))
    assert finder.has_masks
    node = CropFish(CropFishSettings(), camera=None, finder=finder)
    [crop] = [one for one in node.step(frame_of(INPUT, INPUT)) if isinstance(one, FishCrop)]
    assert crop.quality.mask_confidence is None
    assert crop.quality.mask_area_px == pytest.approx(np.pi * 80 * 30, rel=0.05)


def test_other_outputs_than_of_masks_are_refused(tmp_path: Path):
    model = yolo_model(tmp_path / "model.onnx", np.array([[16.0, 16, 80, 48]]))
    with pytest.raises(ModelError, match="2 outputs"):
        OnnxDetector(model, OnnxSettings(onnx_layout="yolo-seg"))
    rows = outputs_of("yolo", np.zeros((40, 4)))
    model = write_model(tmp_path / "flat.onnx", [*rows, np.zeros((1, 8, 8))])
    with pytest.raises(ModelError, match="M, height, width"):
        OnnxDetector(model, OnnxSettings(onnx_layout="yolo-seg"))
