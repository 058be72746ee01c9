"""What detectors put out, by the family they come from, as boxes and scores of one class.

yolo: (1, 4 + C, N), x, y, w, h of the middle and C scores, input pixels (YOLOv8 and later).
yolov5: (1, N, 5 + C), x, y, w, h, objectness, C scores, input pixels (YOLOv5, YOLOX decoded).
yolo-nms: (1, N, 6), left, top, right, bottom, score, class, input pixels (exported with NMS).
detr: boxes (1, N, 4) as x, y, w, h, fractions of the input, and logits (1, N, C + 1), the last of
them "nothing" (DETR). rt-detr: the same with C logits, each by itself (RT-DETR, RF-DETR, DINO).
"""

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

Layout = Literal["yolo", "yolov5", "yolo-nms", "detr", "rt-detr"]
LAYOUTS: tuple[str, ...] = get_args(Layout)
NUM_OUTPUTS = {"yolo": 1, "yolov5": 1, "yolo-nms": 1, "detr": 2, "rt-detr": 2}

Found = tuple[Float[np.ndarray, "N 4"], Float[np.ndarray, "N C"]]  # corners, input px; scores


class WrongShape(ValueError):
    """The outputs are none of this layout; the message says what was expected."""


def decode(outputs: Sequence[np.ndarray], layout: str, *, input_size: tuple[int, int]) -> Found:
    """Boxes as corners in input pixels, and their scores by class. Raises WrongShape."""
    with np.errstate(invalid="ignore", over="ignore"):  # NaN in, NaN out: for others to refuse
        return _DECODERS[layout]([np.asarray(o, np.float64) for o in outputs], input_size)


def _yolo(outputs: list[np.ndarray], _: tuple[int, int]) -> Found:
    (rows,) = outputs
    if rows.ndim != 3 or rows.shape[0] != 1 or rows.shape[1] < 5:
        raise WrongShape("(1, 4 + classes, boxes)")
    if rows.shape[1] > rows.shape[2]:
        raise WrongShape("(1, 4 + classes, boxes) with more boxes than classes")
    return _corners(rows[0, :4].T), rows[0, 4:].T


def _yolov5(outputs: list[np.ndarray], _: tuple[int, int]) -> Found:
    (rows,) = outputs
    if rows.ndim != 3 or rows.shape[0] != 1 or rows.shape[2] < 6:
        raise WrongShape("(1, boxes, 5 + classes)")
    return _corners(rows[0, :, :4]), rows[0, :, 4:5] * rows[0, :, 5:]


def _yolo_nms(outputs: list[np.ndarray], _: tuple[int, int]) -> Found:
    (rows,) = outputs
    if rows.ndim != 3 or rows.shape[0] != 1 or rows.shape[2] != 6:
        raise WrongShape("(1, boxes, 6)")
    classes = np.maximum(rows[0, :, 5], 0).astype(int)
    scores = np.zeros((len(classes), int(classes.max(initial=0)) + 1))
    scores[np.arange(len(classes)), classes] = rows[0, :, 4]
    return rows[0, :, :4], scores


def _detr(outputs: list[np.ndarray], input_size: tuple[int, int]) -> Found:
    boxes, logits = _boxes_and_logits(outputs)
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    return boxes * np.tile(input_size, 2), (odds / odds.sum(axis=1, keepdims=True))[:, :-1]


def _rt_detr(outputs: list[np.ndarray], input_size: tuple[int, int]) -> Found:
    boxes, logits = _boxes_and_logits(outputs)
    return boxes * np.tile(input_size, 2), 1 / (1 + np.exp(-logits.clip(-60, 60)))


def _boxes_and_logits(outputs: list[np.ndarray]) -> Found:
    """The two outputs, in whatever order the export has them."""
    shapes = [output.shape for output in outputs]
    if any(len(shape) != 3 or shape[0] != 1 for shape in shapes) or shapes[0][1] != shapes[1][1]:
        raise WrongShape("(1, boxes, 4) and (1, boxes, classes)")
    boxes = [i for i, shape in enumerate(shapes) if shape[2] == 4]
    if not boxes:
        raise WrongShape("(1, boxes, 4) and (1, boxes, classes)")
    # Where both have four columns, boxes are the one whose numbers are fractions.
    first = min(boxes, key=lambda i: float(np.abs(outputs[i] - 0.5).max(initial=0.0)))
    return _corners(outputs[first][0]), outputs[1 - first][0]


def _corners(boxes: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Middle and size as left, top, right, bottom."""
    half = boxes[:, 2:] / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


_DECODERS: dict[str, Callable[[list[np.ndarray], tuple[int, int]], Found]] = {
    "yolo": _yolo,
    "yolov5": _yolov5,
    "yolo-nms": _yolo_nms,
    "detr": _detr,
    "rt-detr": _rt_detr,
}
