"""Boxes of what moves, mended by where the last mask ended."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.detections import Detection
from stream_dmr.segmentation.masks.crop import mask_extent

_SURE = 0.9  # mask_confidence of a mask that tells where its fish ends
_LEAST, _FARTHEST = 0.03, 0.1  # of the box's longer side, that a mask's edge is away from its

Box = Float[np.ndarray, "4"]


class LastEdges:
    """How far the masks of the frame before reached beyond the boxes they were looked for in.

    A shape that moves lacks the tail, or holds a piece of line, and mostly will in the next frame.
    """

    def __init__(self) -> None:
        self.beyond: dict[int, np.ndarray] = {}  # px, by track
        self._boxes: Mapping[int, np.ndarray] = {}  # of this frame, as they came

    def mended(
        self, boxes: Mapping[int, np.ndarray], visible: Mapping[int, float], frame: Frame
    ) -> list[Detection]:
        """The boxes of a frame with the edges that the last masks had, and visible fractions.

        Both by track. Their masks are for a segmenter to find.
        """
        self._boxes = boxes
        height, width = frame.image.shape[:2]
        limits = [width, height, width, height]
        return [
            Detection(
                track_id=track,
                bbox_xyxy_px=np.clip(box + self.beyond.get(track, 0.0), 0.0, limits),
                mask=None,
                visible_fraction=visible[track],
            )
            for track, box in boxes.items()
        ]

    def learn(self, crops: Iterable[FishCrop]) -> None:
        """Take note of the masks of the same frame; of tracks without a sure one, nothing."""
        self.beyond = {
            crop.track_id: _beyond(self._boxes[crop.track_id], mask_extent(crop))
            for crop in crops
            if (crop.quality.mask_confidence or 0.0) > _SURE
        }


def _beyond(box: Box, extent: Box | None) -> Box:
    """How far the edges of a mask lie from those of the box that moved, px; 0 where they hardly do.

    Never by much: what a mask has lost it would never get back.
    """
    if extent is None:
        return np.zeros(4)
    size = max(box[2:] - box[:2])
    away = np.clip(extent - box, -_FARTHEST * size, _FARTHEST * size)
    return np.where(abs(away) > _LEAST * size, away, 0.0)
