"""Read the outputs of ONNX detectors by their layout: boxes, scores and masks.

yolo: (1, 4 + C, N), x, y, w, h of the center and C scores, input pixels (YOLOv8 and later).
yolov5: (1, N, 5 + C), x, y, w, h, objectness, C scores, input pixels (YOLOv5, YOLOX decoded).
yolo-nms: (1, N, 6), left, top, right, bottom, score, class, input pixels (exported with NMS).
detr: boxes (1, N, 4) as x, y, w, h, fractions of the input, and logits (1, N, C + 1), the last of
them "nothing" (DETR). rt-detr: the same with C independent logits (RT-DETR, RF-DETR, DINO).

Three kinds find each fish's mask as well, so that no segmenter is needed:

yolo-seg: yolo's rows with M more weights, and M pictures (1, M, h, w) whose weighted sum is the
logits of a mask (YOLOv8-seg and later). rf-detr-seg: rt-detr's boxes and logits, and the logits of
masks (1, N, h, w) (RF-DETR Seg). mask-rcnn: boxes (N, 4) in input pixels, classes (N), scores (N)
and probabilities (N, 1, height, width) (Mask R-CNN of torchvision). A mask spans the whole input.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

Layout = Literal[
    "yolo", "yolov5", "yolo-nms", "detr", "rt-detr", "yolo-seg", "rf-detr-seg", "mask-rcnn"
]
NUM_OUTPUTS: dict[str, int] = {
    "yolo": 1,
    "yolov5": 1,
    "yolo-nms": 1,
    "detr": 2,
    "rt-detr": 2,
    "yolo-seg": 2,
    "rf-detr-seg": 3,
    "mask-rcnn": 4,
}

# x0, y0, x1, y1 in input pixels; scores by class
BoxesAndScores = tuple[Float[np.ndarray, "N 4"], Float[np.ndarray, "N C"]]


class OutputShapeError(ValueError):
    """The outputs are not of the layout; the message contains what was expected."""


def decode(
    outputs: Sequence[np.ndarray], layout: str, *, input_size: tuple[int, int]
) -> BoxesAndScores:
    """Boxes x0, y0, x1, y1 in input pixels, and their scores by class.

    `input_size` is (width, height). Raises OutputShapeError.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # NaN is refused later
        return _DECODERS[layout]([np.asarray(o, np.float64) for o in outputs], input_size)


def _yolo(outputs: list[np.ndarray], _: tuple[int, int]) -> BoxesAndScores:
    (rows,) = outputs
    if rows.ndim != 3 or rows.shape[0] != 1 or rows.shape[1] < 5:
        raise OutputShapeError("(1, 4 + classes, boxes)")
    if rows.shape[1] > rows.shape[2]:
        raise OutputShapeError("(1, 4 + classes, boxes) with more boxes than classes")
    return _corners(rows[0, :4].T), rows[0, 4:].T


def _yolov5(outputs: list[np.ndarray], _: tuple[int, int]) -> BoxesAndScores:
    (rows,) = outputs
    if rows.ndim != 3 or rows.shape[0] != 1 or rows.shape[2] < 6:
        raise OutputShapeError("(1, boxes, 5 + classes)")
    if rows.shape[1] < rows.shape[2]:  # as of "yolo", which would give boxes of noise, or none
        raise OutputShapeError("(1, boxes, 5 + classes) with more boxes than classes")
    return _corners(rows[0, :, :4]), rows[0, :, 4:5] * rows[0, :, 5:]


def _yolo_nms(outputs: list[np.ndarray], _: tuple[int, int]) -> BoxesAndScores:
    (rows,) = outputs
    if rows.ndim != 3 or rows.shape[0] != 1 or rows.shape[2] != 6:
        raise OutputShapeError("(1, boxes, 6)")
    classes = np.maximum(rows[0, :, 5], 0).astype(int)
    scores = np.zeros((len(classes), int(classes.max(initial=0)) + 1))
    scores[np.arange(len(classes)), classes] = rows[0, :, 4]
    return rows[0, :, :4], scores


def _detr(outputs: list[np.ndarray], input_size: tuple[int, int]) -> BoxesAndScores:
    boxes, logits = _boxes_and_logits(outputs)
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    return boxes * np.tile(input_size, 2), (odds / odds.sum(axis=1, keepdims=True))[:, :-1]


def _rt_detr(outputs: list[np.ndarray], input_size: tuple[int, int]) -> BoxesAndScores:
    boxes, logits = _boxes_and_logits(outputs)
    return boxes * np.tile(input_size, 2), _sigmoid(logits)


def _yolo_seg(outputs: list[np.ndarray], size: tuple[int, int]) -> BoxesAndScores:
    rows, pictures = outputs
    if rows.ndim != 3 or pictures.ndim != 4 or rows.shape[1] < 5 + pictures.shape[1]:
        raise OutputShapeError("(1, 4 + classes + M, boxes) and (1, M, height, width)")
    return _yolo([rows[:, : -pictures.shape[1]]], size)


def _rf_detr_seg(outputs: list[np.ndarray], size: tuple[int, int]) -> BoxesAndScores:
    *rest, masks = outputs
    if masks.ndim != 4 or masks.shape[:2] != rest[0].shape[:2]:
        raise OutputShapeError("(1, boxes, 4), (1, boxes, classes), (1, boxes, height, width)")
    return _rt_detr(rest, size)


def _mask_rcnn(outputs: list[np.ndarray], _: tuple[int, int]) -> BoxesAndScores:
    boxes, labels, scores, masks = outputs
    if boxes.ndim != 2 or boxes.shape[1] != 4 or masks.ndim != 4 or masks.shape[1] != 1:
        raise OutputShapeError("(boxes, 4), (boxes), (boxes), (boxes, 1, height, width)")
    return _yolo_nms([np.column_stack([boxes, scores, labels])[None]], (0, 0))


# Fish probability of the box of an index over the whole input, by the layouts that have masks.
MASKS: dict[str, Callable[[Sequence[np.ndarray], int], Float[np.ndarray, "h w"]]] = {
    "yolo-seg": lambda outputs, index: _sigmoid(
        np.tensordot(outputs[0][0, -outputs[1].shape[1] :, index], outputs[1][0], axes=1)
    ),
    "rf-detr-seg": lambda outputs, index: _sigmoid(outputs[2][0, index]),
    "mask-rcnn": lambda outputs, index: outputs[3][index, 0],
}


def _sigmoid(logits: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return 1 / (1 + np.exp(-logits.clip(-60, 60)))


def _boxes_and_logits(outputs: list[np.ndarray]) -> BoxesAndScores:
    """The two outputs, in either order; boxes still as fractions of the input."""
    shapes = [output.shape for output in outputs]
    if any(len(shape) != 3 or shape[0] != 1 for shape in shapes) or shapes[0][1] != shapes[1][1]:
        raise OutputShapeError("(1, boxes, 4) and (1, boxes, classes)")
    boxes = [i for i, shape in enumerate(shapes) if shape[2] == 4]
    if not boxes:
        raise OutputShapeError("(1, boxes, 4) and (1, boxes, classes)")
    # If both have four columns, the boxes are the output with values from 0 to 1.
    first = min(boxes, key=lambda i: float(np.abs(outputs[i] - 0.5).max(initial=0.0)))
    return _corners(outputs[first][0]), outputs[1 - first][0]


def _corners(boxes: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Center and size as left, top, right, bottom."""
    half = boxes[:, 2:] / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


_DECODERS: dict[str, Callable[[list[np.ndarray], tuple[int, int]], BoxesAndScores]] = {
    "yolo": _yolo,
    "yolov5": _yolov5,
    "yolo-nms": _yolo_nms,
    "detr": _detr,
    "rt-detr": _rt_detr,
    "yolo-seg": _yolo_seg,
    "rf-detr-seg": _rf_detr_seg,
    "mask-rcnn": _mask_rcnn,
}
