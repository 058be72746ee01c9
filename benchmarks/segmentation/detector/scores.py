"""How many fish a detector finds in pictures with boxes, and how many of its boxes are fish."""

from pathlib import Path

import numpy as np

from benchmarks.segmentation.detector.training_frames import AnnotatedFrame
from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.detector import box_iou
from stream_dmr.segmentation.detection.onnx_detector import OnnxDetector, OnnxSettings

_MIN_SCORE = 0.01  # of the boxes that count
_SAME = 0.5  # IoU from which on a box is a fish's


def equal_error_score(detector: Path, pictures: list[AnnotatedFrame]) -> str:
    """Recall and precision where they are equal, and the score where that is."""
    opened = OnnxDetector(detector, OnnxSettings(onnx_layout="yolov5"), min_score=_MIN_SCORE)
    scores, hits, num_fish = [], [], 0
    for index, picture in enumerate(pictures):
        found = opened.find(
            Frame(frame_index=index, timestamp_ns=0, image=picture.image, source="")
        )
        found = sorted(found, key=lambda one: -one.score)
        taken: set[int] = set()
        for one in found:
            overlaps = np.array([box_iou(one.bbox_xyxy_px, box) for box in picture.boxes])
            overlaps[list(taken)] = 0
            best = int(overlaps.argmax()) if len(overlaps) else -1
            is_hit = best >= 0 and overlaps[best] >= _SAME
            if is_hit:
                taken.add(best)
            scores.append(one.score)
            hits.append(is_hit)
        num_fish += len(picture.boxes)
    order = np.argsort(scores)[::-1]
    right = np.cumsum(np.array(hits)[order])
    precision, recall = right / np.arange(1, len(right) + 1), right / max(num_fish, 1)
    even = int(np.minimum(precision, recall).argmax())
    score = np.array(scores)[order][even]
    average = float(
        np.sum(np.diff(recall, prepend=0) * np.maximum.accumulate(precision[::-1])[::-1])
    )
    return f"{recall[even]:.3f} of {num_fish} at score {score:.2f}, average precision {average:.3f}"
