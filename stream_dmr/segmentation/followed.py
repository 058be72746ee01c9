"""Fish from nothing but the video: found in every frame, followed, and counted once each."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.counting import CounterSettings, FishCounter
from stream_dmr.segmentation.crop import mask_extent
from stream_dmr.segmentation.detections import Detection
from stream_dmr.segmentation.detector import Detector
from stream_dmr.segmentation.tracking import Tracker, TrackerSettings

_SURE = 0.9  # mask_confidence of a mask that tells where its fish ends
_LEAST, _FARTHEST = 0.03, 0.1  # of the box's longer side, that a mask's edge is away from its


class TrackFishSettings(TrackerSettings, CounterSettings):
    """`[track_fish]`: how detected fish are followed, and which count."""


class FollowedFish:
    """A detector's candidates, followed; those whose masks look like fish get a fish's id."""

    def __init__(self, detector: Detector, settings: TrackFishSettings) -> None:
        self._detector = detector
        self._tracker = Tracker(settings)
        self._counter = FishCounter(settings)
        self._boxes: dict[int, np.ndarray] = {}  # of this frame, by track
        self._beyond: dict[int, np.ndarray] = {}  # of the masks in the frame before, by track

    def detect(self, frame: Frame) -> list[Detection]:
        """What may be fish in one frame, by the numbers of their tracks. Frames come in order."""
        sightings = self._tracker.step(frame, self._detector.find(frame))
        self._boxes = {one.number: one.candidate.bbox_xyxy_px for one in sightings}
        height, width = frame.image.shape[:2]
        return [
            Detection(
                track_id=one.number,
                bbox_xyxy_px=np.clip(
                    self._boxes[one.number] + self._beyond.get(one.number, 0.0),
                    0.0,
                    [width, height, width, height],
                ),
                mask=None,
                visible_fraction=one.visible_fraction,
            )
            for one in sightings
        ]

    def fish(self, number: int) -> int | None:
        """The id of the fish that a track is; None while it doesn't count as one."""
        return self._counter.counted(number)

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """The crops of those tracks that count as fish by now, by the fish's ids."""
        crops = list(crops)
        self._beyond = {
            crop.track_id: _beyond(self._boxes[crop.track_id], mask_extent(crop))
            for crop in crops
            if (crop.quality.mask_confidence or 0.0) > _SURE
        }
        known = [(self._counter.track_id(crop), crop) for crop in crops]
        fish = [replace(crop, track_id=i) for i, crop in known if i is not None]
        return sorted(fish, key=lambda crop: crop.track_id)

    @property
    def warnings(self) -> list[str]:
        """What the user should know at the end, a line each."""
        return []


def _beyond(
    box: Float[np.ndarray, "4"], extent: Float[np.ndarray, "4"] | None
) -> Float[np.ndarray, "4"]:
    """How far the edges of a mask lie from those of the box that moved, px; 0 where they hardly do.

    A shape that moves lacks the tail, or holds a piece of line, and mostly will in the next frame.
    Never by much: what a mask has lost it would never get back.
    """
    if extent is None:
        return np.zeros(4)
    size = max(box[2:] - box[:2])
    away = np.clip(extent - box, -_FARTHEST * size, _FARTHEST * size)
    return np.where(abs(away) > _LEAST * size, away, 0.0)
