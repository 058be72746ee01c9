"""CropFish: every fish of a frame, cut out through an ideal camera of its own."""

from collections.abc import Sequence

from stream_dmr.camera import Camera
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.masks.crop import CropFishSettings, crop_fish
from stream_dmr.segmentation.masks.segmenters import open_segmenter
from stream_dmr.segmentation.tracking.fish_finder import FishFinder


class CropFish:
    """Frame -> FishCrop, one per fish. Without a calibrated camera a nominal one stands in."""

    def __init__(
        self, settings: CropFishSettings, *, camera: Camera | None, detections: FishFinder
    ) -> None:
        """Raises ModelError where the model that `settings.segmenter` names can't be used."""
        self.detections = detections
        self._segmenter = open_segmenter(settings.segmenter)
        self._settings = settings
        self._camera = camera

    def step(self, frame: Frame, /) -> list[FishCrop]:
        """The fish of one frame, by id. Raises AnnotationError where its mask can't be used."""
        if self._camera is None:
            height, width = frame.image.shape[:2]
            self._camera = Camera.nominal(width=width, height=height)
        crops = [
            crop_fish(
                frame,
                detection,
                frame_camera=self._camera,
                settings=self._settings,
                segmenter=self._segmenter,
            )
            for detection in self.detections.detect(frame)
        ]
        return self.detections.admit(crops)

    def tick(self, timestamp_ns: int, /) -> Sequence[FishCrop]:
        """Nothing waits for time to pass here."""
        return ()

    def close(self) -> Sequence[FishCrop]:
        """Nothing is owed at the end."""
        return ()
