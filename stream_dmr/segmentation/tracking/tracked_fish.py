"""Fish from nothing but the video: found in every frame, followed, and counted once each."""

from collections.abc import Iterable
from dataclasses import replace

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.detections import Detection
from stream_dmr.segmentation.detection.detector import Detector
from stream_dmr.segmentation.tracking.box_correction import LastEdges
from stream_dmr.segmentation.tracking.confirmation import CounterSettings, FishCounter
from stream_dmr.segmentation.tracking.tracker import Tracker, TrackerSettings


class TrackFishSettings(TrackerSettings, CounterSettings):
    """`[track_fish]`: how detected fish are followed, and which count."""


class FollowedFish:
    """A detector's candidates, followed; those whose masks look like fish get a fish's id."""

    def __init__(self, detector: Detector, settings: TrackFishSettings) -> None:
        self._detector = detector
        self._tracker = Tracker(settings)
        self._counter = FishCounter(settings)
        self._edges = LastEdges()

    def detect(self, frame: Frame) -> list[Detection]:
        """What may be fish in one frame, by the numbers of their tracks. Frames come in order."""
        sightings = self._tracker.step(frame, self._detector.find(frame))
        boxes = {one.number: one.candidate.bbox_xyxy_px for one in sightings}
        visible = {one.number: one.visible_fraction for one in sightings}
        return self._edges.mended(boxes, visible, frame)

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """The crops of those tracks that count as fish by now, by the fish's ids."""
        crops = list(crops)
        self._edges.learn(crops)
        known = [(self._counter.track_id(crop), crop) for crop in crops]
        fish = [replace(crop, track_id=i) for i, crop in known if i is not None]
        return sorted(fish, key=lambda crop: crop.track_id)

    @property
    def warnings(self) -> list[str]:
        """What the user should know at the end, a line each."""
        return []
