"""Fish from nothing but the video: found in every frame, followed, and counted once each."""

from stream_dmr.messages import Frame
from stream_dmr.segmentation.counting import CounterSettings, FishCounter
from stream_dmr.segmentation.detections import Detection
from stream_dmr.segmentation.detector import Detector
from stream_dmr.segmentation.tracking import Tracker, TrackerSettings


class TrackFishSettings(TrackerSettings, CounterSettings):
    """`[track_fish]`: how detected fish are followed, and which count."""


class FollowedFish:
    """A detector's candidates as fish with ids; their masks are for the segmenter to find."""

    def __init__(self, detector: Detector, settings: TrackFishSettings) -> None:
        self._detector = detector
        self._tracker = Tracker(settings)
        self._counter = FishCounter(settings)

    def detect(self, frame: Frame) -> list[Detection]:
        """The fish of one frame, by id. Frames must come in order."""
        height, width = frame.image.shape[:2]
        sightings = self._tracker.step(frame, self._detector.find(frame))
        known = [
            (self._counter.track_id(sighting, width=width, height=height), sighting)
            for sighting in sightings
        ]
        return [
            Detection(
                track_id=track_id,
                bbox_xyxy_px=sighting.candidate.bbox_xyxy_px,
                mask=None,
                visible_fraction=sighting.visible_fraction,
            )
            for track_id, sighting in sorted(known, key=lambda one: one[0] or 0)
            if track_id is not None
        ]

    @property
    def warnings(self) -> list[str]:
        """What the user should know at the end, a line each."""
        return []
