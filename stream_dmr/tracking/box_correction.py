"""Correct detector boxes by the extents of the previous frame's masks.

A motion blob that misses the tail, or includes a piece of line, mostly does so again in the next
frame. The offset between box and mask of frame t - 1 is therefore applied in frame t.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from stream_dmr.geometry import longer_side
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.crop import Detection
from stream_dmr.segmentation.crop_geometry import mask_bbox_in_frame

# Chosen on simulated scenes (seeds 950 to 953) by mask IoU; see docs/research/raw-video.md.
_MIN_MASK_CONFIDENCE = 0.74  # a mask below it corrects no box
_MIN_OFFSET = 0.03  # of the box's longer side; smaller offsets are outline noise
_MAX_OFFSET = 0.1  # likewise; a larger one would cut a fish off for good where the mask lost a part


class BoxCorrector:
    """Per track, the offset from the detector's box to the extent of the mask found in it."""

    def __init__(self) -> None:
        # (4,) left, top, right, bottom in px, by track number: added to a box by `correct`.
        self._offsets_px: dict[int, np.ndarray] = {}
        self._boxes: Mapping[int, np.ndarray] = {}  # the detector's boxes of the current frame

    def correct(
        self, boxes: Mapping[int, np.ndarray], visible: Mapping[int, float], frame: Frame
    ) -> list[Detection]:
        """Detections of a frame with corrected boxes, without masks.

        `boxes`: (4,) half-open frame pixels, by track number; `visible`: visible fractions, 0 to 1,
        of the same tracks. Corrected boxes are clipped to the frame.
        """
        self._boxes = boxes
        height, width = frame.image.shape[:2]
        limits = [width, height, width, height]
        return [
            Detection(
                source_id=track,
                bbox_xyxy_px=np.clip(box + self._offsets_px.get(track, 0.0), 0.0, limits),
                mask=None,
                visible_fraction=visible[track],
            )
            for track, box in boxes.items()
        ]

    def update(self, crops: Mapping[int, FishCrop]) -> None:
        """Replace the offsets by those of this frame's confident masks, by track number."""
        self._offsets_px = {
            track: _offset_px(self._boxes[track], mask_bbox_in_frame(crop))
            for track, crop in crops.items()
            if (crop.quality.mask_confidence or 0.0) > _MIN_MASK_CONFIDENCE
        }


def _offset_px(
    box: Float[np.ndarray, "4"], extent: Float[np.ndarray, "4"] | None
) -> Float[np.ndarray, "4"]:
    """From the edges of a box to those of a mask, px; 0 for an empty mask and for small offsets."""
    if extent is None:
        return np.zeros(4)
    size = longer_side(box)
    offset = np.clip(extent - box, -_MAX_OFFSET * size, _MAX_OFFSET * size)
    return np.where(abs(offset) > _MIN_OFFSET * size, offset, 0.0)
