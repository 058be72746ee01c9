"""Outputs of every family of detectors decode to the boxes and scores that they encode."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.onnx_outputs import OutputShapeError, decode

INPUT = (320, 240)  # width, height


def some_boxes(seed: int, count: int, classes: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 100, (count, 2))
    boxes = np.hstack([low, low + rng.uniform(5, 100, (count, 2))])
    return boxes, rng.uniform(0.05, 0.9 / classes, (count, classes))


def center_and_size(boxes: np.ndarray) -> np.ndarray:
    return np.hstack([(boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]])


def encode(layout: str, boxes: np.ndarray, scores: np.ndarray) -> list[np.ndarray]:
    centers, fractions = center_and_size(boxes), center_and_size(boxes) / np.tile(INPUT, 2)
    match layout:
        case "yolo":
            return [np.hstack([centers, scores]).T[None]]
        case "yolov5":
            return [np.hstack([centers, np.full((len(boxes), 1), 0.5), 2 * scores])[None]]
        case "detr":
            nothing = np.log(1 - scores.sum(axis=1, keepdims=True))
            return [np.hstack([np.log(scores), nothing])[None], fractions[None]]
    return [fractions[None], np.log(scores / (1 - scores))[None]]


@pytest.mark.parametrize("layout", ["yolo", "yolov5", "detr", "rt-detr"])
@given(st.integers(0, 999), st.integers(1, 4), st.booleans())
def test_decoding_reverts_encoding(layout: str, seed: int, classes: int, swapped: bool):
    boxes, scores = some_boxes(seed, 12, classes)
    outputs = encode(layout, boxes, scores)
    found, found_scores = decode(outputs[::-1] if swapped else outputs, layout, input_size=INPUT)
    np.testing.assert_allclose(found, boxes, atol=1e-9)
    np.testing.assert_allclose(found_scores, scores, atol=1e-9)


def test_after_suppression_each_box_has_the_score_of_its_class():
    rows = np.array([[1.0, 2, 3, 4, 0.9, 0], [5.0, 6, 7, 8, 0.8, 2]])
    boxes, scores = decode([rows[None]], "yolo-nms", input_size=INPUT)
    np.testing.assert_array_equal(boxes, rows[:, :4])
    np.testing.assert_array_equal(scores, [[0.9, 0, 0], [0, 0, 0.8]])


@pytest.mark.parametrize("layout", ["yolo", "yolov5", "yolo-nms"])
def test_outputs_of_another_shape_are_refused(layout: str):
    with pytest.raises(OutputShapeError):
        decode([np.zeros((2, 3))], layout, input_size=INPUT)
