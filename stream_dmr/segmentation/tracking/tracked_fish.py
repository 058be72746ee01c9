"""Fish found in the video alone: detected in every frame, tracked, and confirmed by their masks."""

from collections.abc import Iterable
from dataclasses import replace

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.detection.detector import Detector
from stream_dmr.segmentation.detection.fish_detection import Detection
from stream_dmr.segmentation.tracking.box_correction import BoxCorrector
from stream_dmr.segmentation.tracking.confirmation import ConfirmationSettings, FishConfirmation
from stream_dmr.segmentation.tracking.tracker import Tracker, TrackerSettings


class TrackFishSettings(TrackerSettings, ConfirmationSettings):
    """`[track_fish]`: how detected fish are followed, and which count."""


class TrackedFish:
    """A `FishFinder` that tracks a detector's candidates and confirms those with fish masks."""

    def __init__(self, detector: Detector, settings: TrackFishSettings) -> None:
        self._detector = detector
        self._tracker = Tracker(settings)
        self._confirmation = FishConfirmation(settings)
        self._corrector = BoxCorrector()

    def detect(self, frame: Frame) -> list[Detection]:
        """All tracks seen in a frame, by track number. Frames must come in order."""
        tracked = self._tracker.step(frame, self._detector.find(frame))
        boxes = {one.track_number: one.candidate.bbox_xyxy_px for one in tracked}
        visible = {one.track_number: one.visible_fraction for one in tracked}
        return self._corrector.correct(boxes, visible, frame)

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """The crops of confirmed fish, with fish ids instead of track numbers, ordered by id."""
        crops = list(crops)
        self._corrector.update(crops)
        ids = [self._confirmation.update(crop) for crop in crops]
        fish = [
            replace(crop, track_id=i) for i, crop in zip(ids, crops, strict=True) if i is not None
        ]
        return sorted(fish, key=lambda crop: crop.track_id)

    @property
    def warnings(self) -> list[str]:
        """Always empty: a missed fish is not noticed."""
        return []
