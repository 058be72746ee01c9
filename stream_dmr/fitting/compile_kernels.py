"""Compile the kernels before the first frame, by two fits of a drawn fish.

Numba compiles a kernel when it is first called. All of them take a minute on a new installation, in
which a camera's frames would be lost.
"""

import cv2
import numpy as np

from stream_dmr.camera import Camera
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.messages import CropQuality, FishCrop

_SIZE_PX = 128


def compile_kernels(fitter: Fitter) -> None:
    """Fit a drawn fish once from cold and once from warm, which calls every kernel."""
    crop = drawn_fish()
    fitter.fit(crop, fitter.fit(crop, None).best)


def drawn_fish() -> FishCrop:
    """The crop of an ellipse."""
    mask = np.zeros((_SIZE_PX, _SIZE_PX), np.uint8)
    middle = _SIZE_PX // 2
    cv2.ellipse(mask, (middle, middle), (_SIZE_PX // 3, _SIZE_PX // 8), 30, 0, 360, 1, cv2.FILLED)
    camera = Camera.nominal(width=_SIZE_PX, height=_SIZE_PX)
    return FishCrop(
        frame_index=0,
        timestamp_ns=0,
        track_id=0,
        bbox_xyxy_px=np.array([0.0, 0.0, _SIZE_PX, _SIZE_PX]),
        image=None,
        mask=mask > 0,
        crop_camera=camera,
        frame_camera=camera,
        quality=CropQuality(
            touches_border=False,
            visible_fraction=1.0,
            sharpness=0.0,
            mask_area_px=float(mask.sum()),
        ),
    )
