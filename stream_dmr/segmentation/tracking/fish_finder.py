"""The source of a run's fish: annotation files, or detection and tracking in the video itself."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.annotated_box import UNKNOWN_ID
from stream_dmr.segmentation.annotations.annotated_fish import AnnotatedFish, open_annotated_fish
from stream_dmr.segmentation.annotations.box_detector import BoxDetector
from stream_dmr.segmentation.annotations.box_files import load_boxes
from stream_dmr.segmentation.annotations.mask_folder import MaskFolder
from stream_dmr.segmentation.annotations.named_pictures import NamedPictures, names_pictures
from stream_dmr.segmentation.detection.fish_detection import Detection
from stream_dmr.segmentation.detection.open_detector import DetectFishSettings, open_detector
from stream_dmr.segmentation.tracking.tracked_fish import TrackedFish, TrackFishSettings


@runtime_checkable
class FishFinder(Protocol):
    """Finds the fish of each frame: `detect` before the crops are cut, then `confirm`."""

    @property
    def gives_masks(self) -> bool:
        """True where every detection comes with a mask, so that no segmenter is needed."""
        ...

    @property
    def warnings(self) -> list[str]:
        """What the user should know of the frames so far, one line each; complete at the end."""
        ...

    @property
    def unused(self) -> list[str]:
        """What of the given files no frame so far had, one line each.

        True of the whole source only once it was read to its end.
        """
        ...

    def detect(self, frame: Frame) -> list[Detection]:
        """What may be fish in one frame. Raises AnnotationError for an unusable mask."""
        ...

    @property
    def knows_ids(self) -> bool:
        """True where `source_id` is the id that somebody gave the fish."""
        ...

    def confirm(self, crops: Mapping[int, FishCrop]) -> list[int]:
        """Those of the frame's detections that are fish; `crops` and results by `source_id`."""
        ...


def open_finder(
    *,
    boxes: Path | None,
    masks: Path | None,
    detect: DetectFishSettings,
    track: TrackFishSettings,
    pictures: Path | None = None,
) -> FishFinder:
    """Fish from annotation files where given; tracked ones otherwise, and for boxes without ids.

    `pictures`: the source of the frames, after which masks and boxes may be named.
    Raises AnnotationError or ModelError where a file cannot be read.
    """
    if boxes is None and masks is None:
        return TrackedFish(open_detector(detect), track)
    if boxes is not None and names_pictures(boxes):
        folder = None if masks is None else MaskFolder(masks, pictures=pictures)
        return NamedPictures(boxes, folder or open_detector(detect))
    if boxes is None or masks is not None:
        return open_annotated_fish(
            boxes=boxes, masks=masks, pictures=pictures, across_frames=track.across_frames
        )
    frames = load_boxes(boxes, pictures=pictures)
    if any(box.track_id == UNKNOWN_ID for found in frames.values() for box in found):
        return TrackedFish(BoxDetector(frames), track)
    return AnnotatedFish(boxes=frames, masks=None, across_frames=track.across_frames)
