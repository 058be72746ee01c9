"""CropFish: every fish of a frame, cut out through an ideal camera of its own."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

from stream_dmr.camera import Camera
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.crop import CropFishSettings, crop_fish
from stream_dmr.segmentation.open_segmenter import open_segmenter
from stream_dmr.segmentation.species_classifier import SpeciesClassifier
from stream_dmr.tracking.finder import FishFinder
from stream_dmr.tracking.tracker import TrackNumbering


class CropFish:
    """Frame -> FishCrop, one per fish. Without a calibrated camera a nominal one is assumed."""

    def __init__(
        self,
        settings: CropFishSettings,
        *,
        camera: Camera | None,
        finder: FishFinder,
        species_model: str = "",
    ) -> None:
        """Raises ModelError where a model that the settings name cannot be used.

        The segmenter is not opened, and torch is not imported, where the finder gives all masks.
        `species_model`: the file of a classifier; "": none.
        """
        self._finder = finder
        self._numbering = TrackNumbering(keeps_source_ids=finder.knows_ids)
        self._segmenter = None if finder.gives_masks else open_segmenter(settings.segmenter)
        self._classifier = SpeciesClassifier(Path(species_model)) if species_model else None
        self._settings = settings
        self._camera = camera
        # Networks run side by side; given masks are cut out mostly by Python, which can't.
        workers = ThreadPoolExecutor(os.cpu_count(), "crop")
        self._map = map if self._segmenter is None else workers.map

    def number_after(self, track_id: int) -> None:
        """Number the fish on after those of earlier runs; call it before the first frame."""
        self._numbering.resume_after(track_id)

    def step(self, frame: Frame, /) -> list[FishCrop]:
        """The fish of one frame, by id. Raises AnnotationError for an unusable mask."""
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
            one.source_id: crop for one, crop in zip(found, self._map(cut, found), strict=True)
        }
        fish = [
            replace(
                crops[source_id],
                track_id=self._numbering.track_id(source_id),
                species=self._classifier.classify(crops[source_id]) if self._classifier else {},
            )
            for source_id in self._finder.confirm(crops)
        ]
        return sorted(fish, key=lambda crop: crop.track_id)

    def tick(self, timestamp_ns: int, /) -> Sequence[FishCrop]:
        """No output: crops do not wait for time to pass."""
        return ()

    def close(self) -> Sequence[FishCrop]:
        """No output at the end."""
        return ()
