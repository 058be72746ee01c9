"""Crops by masks that a test gives."""

import numpy as np

from stream_dmr.camera import Camera
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.crop import CropFishSettings, Detection, crop_fish
from tests.support.frames import grey_frame


def detection_of(mask: np.ndarray, *, box: object = None) -> Detection:
    """A detection with this mask and a box, by default the tightest."""
    if box is None:
        rows, columns = np.nonzero(mask)
        box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    return Detection(
        source_id=1, bbox_xyxy_px=np.array(box, np.float64), mask=mask, visible_fraction=1.0
    )


def crop_of(
    mask: np.ndarray,
    camera: Camera,
    *,
    box: object = None,
    frame: Frame | None = None,
    **settings: object,
) -> FishCrop:
    return crop_fish(
        frame or grey_frame(camera),
        detection_of(mask, box=box),
        frame_camera=camera,
        settings=CropFishSettings.model_validate(settings),
        segmenter=None,
    )
