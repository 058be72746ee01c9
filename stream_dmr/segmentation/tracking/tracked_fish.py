"""Fish found in the video alone: detected in every frame, tracked, and confirmed by their masks."""

from collections.abc import Mapping

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

    @property
    def knows_ids(self) -> bool:
        """False: track numbers also count what turns out to be no fish."""
        return False

    def confirm(self, crops: Mapping[int, FishCrop]) -> list[int]:
        """The track numbers of confirmed fish; `crops` are those of all detections of the frame."""
        self._corrector.update(crops)
        return [track for track, crop in crops.items() if self._confirmation.update(track, crop)]

    @property
    def gives_masks(self) -> bool:
        """False: the segmenter finds the masks."""
        return False

    @property
    def warnings(self) -> list[str]:
        """Always empty: a missed fish is not noticed."""
        return []
