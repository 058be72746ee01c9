"""CropFish: every fish of a frame, cut out through an ideal camera of its own; ends of tracks."""

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

from stream_dmr.camera import Camera
from stream_dmr.messages import FishCrop, Frame, TrackEnded
from stream_dmr.segmentation.crop import CropFishSettings, crop_fish
from stream_dmr.segmentation.open_segmenter import open_segmenter
from stream_dmr.segmentation.species_classifier import SpeciesClassifier
from stream_dmr.tracking.finder import FishFinder, TrackedFish
from stream_dmr.tracking.timeout import TrackTimeout
from stream_dmr.tracking.tracker import TrackNumbering


class CropFish:
    """Frame -> FishCrop of each fish, then TrackEnded of each fish that no later frame will show.

    When a track is confirmed as a fish, its crops of earlier frames come first. Without a
    calibrated camera a nominal camera is assumed.
    """

    def __init__(
        self,
        settings: CropFishSettings,
        *,
        camera: Camera | None,
        finder: FishFinder,
        species_model: str = "",
        track_timeout_s: float = 10.0,
    ) -> None:
        """Raises ModelError if a model that the settings name cannot be used.

        The segmenter is not opened, and torch is not imported, if the finder has all masks.
        `species_model`: the file of a classifier; "": none. Tracks of given ids end when they are
        unseen for `track_timeout_s`.
        """
        self._finder = finder
        self._numbering = TrackNumbering(keeps_source_ids=finder.open_ids is None)
        self._segmenter = None if finder.has_masks else open_segmenter(settings.segmenter)
        self._classifier = SpeciesClassifier(Path(species_model)) if species_model else None
        self._settings = settings
        self._camera = camera
        self._timeout = TrackTimeout(track_timeout_s)
        self._open: dict[int, int] = {}  # source ids by track id
        self._interrupted: list[int] = []  # track ids of an earlier run
        self._last: Frame | None = None
        # Networks run side by side; given masks are cut out mostly by Python, which can't.
        workers = ThreadPoolExecutor(os.cpu_count(), "crop")
        self._map = map if self._segmenter is None else workers.map

    def number_after(self, track_id: int, *, interrupted: Collection[int] = ()) -> None:
        """Continue the numbers of the fish of earlier runs; call it before the first frame.

        Tracks that were open when an earlier run broke off end with the first frame.
        """
        self._numbering.resume_after(track_id)
        self._interrupted = sorted(interrupted)

    def step(self, frame: Frame, /) -> list[FishCrop | TrackEnded]:
        """The fish of a frame, by id. Raises AnnotationError for an unusable mask."""
        height, width = frame.image.shape[:2]
        camera = self._camera or Camera.nominal(width=width, height=height)
        cut = partial(
            crop_fish,
            frame,
            frame_camera=camera,
            settings=self._settings,
            segmenter=self._segmenter,
        )
        found = self._finder.detect(frame)
        crops = {
            detection.source_id: crop
            for detection, crop in zip(found, self._map(cut, found), strict=True)
        }
        confirmed = self._finder.confirm(crops)
        fish = {self._numbering.track_id(source_id): source_id for source_id in confirmed}
        self._open |= fish
        self._last = frame
        return [*self._crops(fish, confirmed), *self._ends(frame, fish)]

    def pause(self) -> list[FishCrop | TrackEnded]:
        """End all open tracks, unless their ids are given; the next frame shows other fish."""
        if not self._open or not isinstance(self._finder, TrackedFish):
            return []
        self._finder.forget_tracks()
        return self._end_all("pause")

    def close(self) -> list[FishCrop | TrackEnded]:
        """End all open tracks with the source."""
        return self._end_all("end")

    def _end_all(self, cause: str) -> list[FishCrop | TrackEnded]:
        last, ended = self._last, [*self._open]
        self._open.clear()
        return (
            [] if last is None else [TrackEnded.after(last, track_id, cause) for track_id in ended]
        )

    def _crops(
        self, fish: Mapping[int, int], shown: Mapping[int, Sequence[FishCrop]]
    ) -> Iterator[FishCrop]:
        for track_id, source_id in sorted(fish.items()):
            for crop in shown[source_id]:
                species = self._classifier.classify(crop) if self._classifier else {}
                yield replace(crop, track_id=track_id, species=species)

    def _ends(self, frame: Frame, fish: Collection[int]) -> Iterator[TrackEnded]:
        while self._interrupted:
            yield TrackEnded.after(frame, self._interrupted.pop(0), "restart")
        open_ids = self._finder.open_ids
        if open_ids is None:
            ended, cause = self._timeout.step(frame.timestamp_ns, fish), "timeout"
        else:
            ended, cause = [i for i, source in self._open.items() if source not in open_ids], "lost"
        for track_id in ended:
            del self._open[track_id]
            yield TrackEnded.after(frame, track_id, cause)
