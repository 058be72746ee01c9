"""How many fish a detector finds in pictures with boxes, and how many of its boxes are fish.

    python -m benchmarks.segmentation.detector.scores CLONES fish.onnx

of the frames that are held back: see `frame_sources`.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.segmentation.detector.frame_sources import read_sources
from benchmarks.segmentation.detector.training_frames import AnnotatedFrame
from stream_dmr.detection.network_detectors import OnnxDetector, OnnxSettings
from stream_dmr.geometry import box_iou
from stream_dmr.messages import Frame

_MIN_SCORE = 0.01  # of the boxes that count
_SAME = 0.5  # IoU from which on a box is a fish's
_THRESHOLDS = (0.15, 0.3, 0.6)  # that tracking asks for


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoredBoxes:
    """The boxes that a detector found in some pictures, best first."""

    scores: Float[np.ndarray, "N"]
    is_fish: Bool[np.ndarray, "N"]  # a fish's best box, of IoU 0.5 and more
    num_fish: int
    num_pictures: int

    def recall_and_wrong(self, threshold: float) -> tuple[float, float]:
        """Of boxes with such a score: the share of all fish, and how many a picture are none."""
        hits = self.is_fish[self.scores >= threshold]
        return hits.sum() / max(self.num_fish, 1), (~hits).sum() / max(self.num_pictures, 1)

    @property
    def summary(self) -> str:
        """Recall and precision where they are equal, the score there, and the average precision."""
        right = np.cumsum(self.is_fish)
        precision, recall = right / np.arange(1, len(right) + 1), right / max(self.num_fish, 1)
        even = int(np.minimum(precision, recall).argmax())
        best_later = np.maximum.accumulate(precision[::-1])[::-1]
        average = float(np.sum(np.diff(recall, prepend=0) * best_later))
        return (
            f"{recall[even]:.3f} of {self.num_fish} at score {self.scores[even]:.2f}, "
            f"average precision {average:.3f}"
        )


def score(detector: Path, pictures: list[AnnotatedFrame]) -> ScoredBoxes:
    """Look at all pictures; every fish is found once, by the best box that is left."""
    opened = OnnxDetector(detector, OnnxSettings(onnx_layout="yolov5"), min_score=_MIN_SCORE)
    scores, hits = [], []
    for index, picture in enumerate(pictures):
        found = opened.find(
            Frame(frame_index=index, timestamp_ns=0, image=picture.image, source="")
        )
        taken: set[int] = set()
        for one in sorted(found, key=lambda one: -one.score):
            overlaps = np.array([box_iou(one.bbox_xyxy_px, box) for box in picture.boxes])
            overlaps[list(taken)] = 0
            best = int(overlaps.argmax()) if len(overlaps) else -1
            is_hit = best >= 0 and overlaps[best] >= _SAME
            if is_hit:
                taken.add(best)
            scores.append(one.score)
            hits.append(is_hit)
    order = np.argsort(scores)[::-1]
    return ScoredBoxes(
        scores=np.array(scores, np.float64)[order],
        is_fish=np.array(hits, bool)[order],
        num_fish=sum(len(picture.boxes) for picture in pictures),
        num_pictures=len(pictures),
    )


def main() -> None:
    """Print a row per source and detector."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("repositories", type=Path)
    parser.add_argument("detectors", type=Path, nargs="+")
    arguments = parser.parse_args()
    _, held_back = read_sources(arguments.repositories)
    for detector in arguments.detectors:
        for name, pictures in held_back.items():
            scored = score(detector, pictures)
            rates = [scored.recall_and_wrong(threshold) for threshold in _THRESHOLDS]
            print(
                f"{detector} {name}: {scored.summary}; "
                + ", ".join(f"{recall:.2f} and {wrong:.2f}" for recall, wrong in rates),
                flush=True,
            )


if __name__ == "__main__":
    main()
