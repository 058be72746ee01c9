"""A piece of a source: some of its frames, and in them some of its fish."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.detections import Detection
from stream_dmr.segmentation.tracking.fish_finder import FishFinder
from stream_dmr.sources.source import Source


@dataclass(frozen=True, kw_only=True)
class Only:
    """Which ones."""

    first: int  # frame
    last: int  # frame, included
    tracks: frozenset[int]
    sightings: Path | None = None  # of a scout, where no files say where the fish are


@runtime_checkable
class Frames(Protocol):
    """The head of a chain."""

    source: Source

    def __iter__(self) -> Iterator[Frame]: ...

    def close(self) -> None:
        """Let go of the source."""
        ...


class OnlyFrames:
    """The frames of a piece, by the numbers and times that they have in the whole."""

    def __init__(self, whole: Frames, only: Only) -> None:
        self.source = whole.source
        self._whole = whole
        self._only = only

    def __iter__(self) -> Iterator[Frame]:
        """Those before the piece are read, too: a video tells times only in a row."""
        for frame in self._whole:
            if frame.frame_index > self._only.last:
                return
            if frame.frame_index >= self._only.first:
                yield frame

    def close(self) -> None:
        """Let go of the source."""
        self._whole.close()


class OnlyFish:
    """A finder that overlooks the other fish."""

    def __init__(self, finder: FishFinder, only: Only) -> None:
        self._finder = finder
        self._only = only

    @property
    def warnings(self) -> list[str]:
        """Those of the finder."""
        return self._finder.warnings

    def detect(self, frame: Frame) -> list[Detection]:
        """See `FishFinder`. By the ids of files: those of followed fish come later."""
        return [one for one in self._finder.detect(frame) if one.track_id in self._only.tracks]

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """See `FishFinder`."""
        return self._finder.admit(crops)
