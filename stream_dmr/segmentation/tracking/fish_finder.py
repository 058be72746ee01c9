"""Where the fish of a run come from: files that somebody made, or the video itself."""

from collections.abc import Iterable
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.box_detector import BoxDetector
from stream_dmr.segmentation.annotations.boxes import UNKNOWN_ID
from stream_dmr.segmentation.annotations.detections import Annotations, Detection, open_annotations
from stream_dmr.segmentation.annotations.files import load_boxes
from stream_dmr.segmentation.detection.detectors import DetectFishSettings, open_detector
from stream_dmr.segmentation.tracking.tracked_fish import FollowedFish, TrackFishSettings


@runtime_checkable
class FishFinder(Protocol):
    """Which fish are in a frame."""

    @property
    def warnings(self) -> list[str]:
        """What the user should know of the frames so far, a line each; best read at the end."""
        ...

    def detect(self, frame: Frame) -> list[Detection]:
        """What may be fish in one frame. Raises AnnotationError where its mask can't be used."""
        ...

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """Those of the frame's crops that are of fish, by the fish's ids."""
        ...


def open_finder(
    *, boxes: Path | None, masks: Path | None, detect: DetectFishSettings, track: TrackFishSettings
) -> FishFinder:
    """The fish that the files describe; without files, and for boxes without ids, followed ones.

    Raises AnnotationError or ModelError where what is asked for can't be read.
    """
    if boxes is None and masks is None:
        return FollowedFish(open_detector(detect), track)
    if boxes is None or masks is not None:
        return open_annotations(boxes=boxes, masks=masks)
    frames = load_boxes(boxes)
    if any(box.track_id == UNKNOWN_ID for found in frames.values() for box in found):
        return FollowedFish(BoxDetector(frames), track)
    return Annotations(boxes=frames, masks=None)
