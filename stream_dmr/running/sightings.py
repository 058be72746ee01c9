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
from stream_dmr.segmentation.annotations.detections import Detection
from stream_dmr.segmentation.tracking.box_correction import LastEdges
from stream_dmr.segmentation.tracking.tracked_fish import FollowedFish


class Noted(NamedTuple):
    """What a scout notes of a fish in a frame, as the detector saw it. Boxes: half-open, px."""

    frame_index: int
    track_id: int
    visible_fraction: float
    left: float
    top: float
    right: float
    bottom: float
    beyond_left: float  # how far the edges were moved, see `LastEdges`; in a fish's first frame
    beyond_top: float
    beyond_right: float
    beyond_bottom: float

    @property
    def box(self) -> Float[np.ndarray, "4"]:
        """As the detector gave it."""
        return np.array(self[3:7])

    @property
    def beyond(self) -> Float[np.ndarray, "4"]:
        """What was added to it."""
        return np.array(self[7:])


class Scout:
    """A finder that asks for no crop of a fish once it counts, and notes where all of them are."""

    def __init__(self, finder: FollowedFish) -> None:
        self._finder = finder
        self._doubtful: list[Detection] = []  # of this frame
        self.sightings: list[Noted] = []

    @property
    def warnings(self) -> list[str]:
        """Those of the finder."""
        return self._finder.warnings

    def detect(self, frame: Frame) -> list[Detection]:
        """See `FishFinder`: only those of which it is not known yet whether they are fish."""
        found = self._finder.detect(frame)
        self._doubtful = [one for one in found if self._finder.fish(one.track_id) is None]
        self._note(frame.frame_index, found)
        return self._doubtful

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """See `FishFinder`."""
        admitted = self._finder.admit(crops)
        for crop in admitted[:1]:
            self._note(crop.frame_index, self._doubtful)
        return admitted

    def _note(self, frame_index: int, found: Iterable[Detection]) -> None:
        """Those that count by now, by the fish's ids."""
        finder = self._finder
        for one in found:
            fish = finder.fish(one.track_id)
            if fish is not None:
                box, beyond = finder.boxes[one.track_id], finder.beyond.get(one.track_id)
                moved = [0.0] * 4 if beyond is None else beyond.tolist()
                where = (frame_index, fish, one.visible_fraction)
                self.sightings.append(Noted(*where, *box.tolist(), *moved))


class SightedFish:
    """A finder that reads where the fish are from the notes of a scout."""

    def __init__(self, path: Path) -> None:
        self.warnings: list[str] = []  # a scout has said them
        self._frames: defaultdict[int, list[Noted]] = defaultdict(list)
        self._edges = LastEdges()
        self._known = set[int]()
        for one in read_sightings(path):
            self._frames[one.frame_index].append(one)

    def detect(self, frame: Frame) -> list[Detection]:
        """See `FishFinder`."""
        seen = self._frames.get(frame.frame_index, [])
        for one in seen:
            if one.track_id not in self._known:  # its masks so far are those of the scout
                self._known.add(one.track_id)
                self._edges.beyond[one.track_id] = one.beyond
        visible = {one.track_id: one.visible_fraction for one in seen}
        return self._edges.mended({one.track_id: one.box for one in seen}, visible, frame)

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """See `FishFinder`: what was noted is fish."""
        crops = sorted(crops, key=lambda crop: crop.track_id)
        self._edges.learn(crops)
        return crops


def write_sightings(path: Path, sightings: Iterable[Noted]) -> None:
    """As CSV; numbers as Python writes them, so that they are read to the last bit."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Noted._fields)
        writer.writerows(sightings)


def read_sightings(path: Path) -> Iterator[Noted]:
    """What `write_sightings` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        lines = csv.reader(file)
        next(lines)
        for frame_index, track_id, *numbers in lines:
            yield Noted(int(frame_index), int(track_id), *map(float, numbers))
