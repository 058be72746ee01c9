"""Fish of a raw video, found and followed once, so that its pieces need not do it again.

What a detector and a tracker make of a frame depends on all frames before it; masks and fits of a
fish on its own frames alone. So one way through the video notes which fish is where, with masks of
those only that don't count as fish yet, and any part of the video can be measured by these notes.
"""

import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.detections import Detection
from stream_dmr.segmentation.followed import FollowedFish


class Sighting(NamedTuple):
    """A fish in a frame, as `Detection` has it."""

    frame_index: int
    track_id: int
    left: float  # of the box, half-open, frame pixels
    top: float
    right: float
    bottom: float
    visible_fraction: float


class Scout:
    """A finder that asks for no crop of a fish once it counts, and notes where all of them are."""

    def __init__(self, finder: FollowedFish) -> None:
        self._finder = finder
        self.sightings: list[Sighting] = []

    @property
    def warnings(self) -> list[str]:
        """Those of the finder."""
        return self._finder.warnings

    def detect(self, frame: Frame) -> list[Detection]:
        """See `FishFinder`: only those of which it is not known yet whether they are fish."""
        doubtful = []
        for one in self._finder.detect(frame):
            fish = self._finder.fish(one.track_id)
            if fish is None:
                doubtful.append(one)
            else:
                self._note(frame.frame_index, fish, one.bbox_xyxy_px, one.visible_fraction)
        return doubtful

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """See `FishFinder`."""
        admitted = self._finder.admit(crops)
        for crop in admitted:
            seen = crop.quality.visible_fraction
            self._note(crop.frame_index, crop.track_id, crop.bbox_xyxy_px, seen)
        return admitted

    def _note(
        self, frame_index: int, track_id: int, bbox_xyxy_px: Float[np.ndarray, "4"], visible: float
    ) -> None:
        left, top, right, bottom = bbox_xyxy_px.tolist()
        self.sightings.append(
            Sighting(frame_index, track_id, left, top, right, bottom, visible_fraction=visible)
        )


class SightedFish:
    """A finder that reads where the fish are from the notes of a scout."""

    def __init__(self, path: Path) -> None:
        self.warnings: list[str] = []  # a scout has said them
        self._frames: defaultdict[int, list[Sighting]] = defaultdict(list)
        for one in read_sightings(path):
            self._frames[one.frame_index].append(one)

    def detect(self, frame: Frame) -> list[Detection]:
        """See `FishFinder`."""
        return [
            Detection(
                track_id=one.track_id,
                bbox_xyxy_px=np.array([one.left, one.top, one.right, one.bottom]),
                mask=None,
                visible_fraction=one.visible_fraction,
            )
            for one in self._frames.get(frame.frame_index, ())
        ]

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """See `FishFinder`: what was noted is fish."""
        return sorted(crops, key=lambda crop: crop.track_id)


def write_sightings(path: Path, sightings: Iterable[Sighting]) -> None:
    """As CSV; numbers as Python writes them, so that they are read to the last bit."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Sighting._fields)
        writer.writerows(sightings)


def read_sightings(path: Path) -> Iterator[Sighting]:
    """What `write_sightings` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        lines = csv.reader(file)
        next(lines)
        for frame_index, track_id, *numbers in lines:
            yield Sighting(int(frame_index), int(track_id), *map(float, numbers))
