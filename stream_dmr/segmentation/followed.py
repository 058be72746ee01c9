"""Fish from nothing but the video: found in every frame, followed, and counted once each."""

from collections.abc import Iterable
from dataclasses import replace

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.counting import CounterSettings, FishCounter
from stream_dmr.segmentation.detections import Detection
from stream_dmr.segmentation.detector import Detector
from stream_dmr.segmentation.tracking import Tracker, TrackerSettings


class TrackFishSettings(TrackerSettings, CounterSettings):
    """`[track_fish]`: how detected fish are followed, and which count."""


class FollowedFish:
    """A detector's candidates, followed; those whose masks look like fish get a fish's id."""

    def __init__(self, detector: Detector, settings: TrackFishSettings) -> None:
        self._detector = detector
        self._tracker = Tracker(settings)
        self._counter = FishCounter(settings)

    def detect(self, frame: Frame) -> list[Detection]:
        """What may be fish in one frame, by the numbers of their tracks. Frames come in order."""
        return [
            Detection(
                track_id=sighting.number,
                bbox_xyxy_px=sighting.candidate.bbox_xyxy_px,
                mask=None,
                visible_fraction=sighting.visible_fraction,
            )
            for sighting in self._tracker.step(frame, self._detector.find(frame))
        ]

    def fish(self, number: int) -> int | None:
        """The id of the fish that a track is; None while it doesn't count as one."""
        return self._counter.counted(number)

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """The crops of those tracks that count as fish by now, by the fish's ids."""
        known = [(self._counter.track_id(crop), crop) for crop in crops]
        fish = [replace(crop, track_id=i) for i, crop in known if i is not None]
        return sorted(fish, key=lambda crop: crop.track_id)

    @property
    def warnings(self) -> list[str]:
        """What the user should know at the end, a line each."""
        return []
