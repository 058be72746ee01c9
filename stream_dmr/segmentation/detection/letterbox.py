"""Fit a frame into a network's input, and map boxes back to the frame exactly."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_GREY_LEVEL = 114  # of the bars, as the YOLO family is trained


@dataclass(frozen=True, eq=False, kw_only=True)
class Letterbox:
    """Input pixels are frame pixels times `scale` plus `offset`, counted from pixel edges.

    A frame is resized to whole pixels, so its two sides may scale by slightly different factors.
    """

    input_size: tuple[int, int]  # width, height
    resized: tuple[int, int]  # of the frame inside the input; width, height
    offset: Float[np.ndarray, "2"]
    scale: Float[np.ndarray, "2"]

    @classmethod
    def from_sizes(cls, *, frame_size: tuple[int, int], input_size: tuple[int, int]) -> "Letterbox":
        """The largest picture of a frame's proportions, centered in the input; (width, height)."""
        ratio = min(input_size[0] / frame_size[0], input_size[1] / frame_size[1])
        resized = tuple(max(1, round(side * ratio)) for side in frame_size)
        offset = [(inner - side) // 2 for inner, side in zip(input_size, resized, strict=True)]
        return cls(
            input_size=input_size,
            resized=(resized[0], resized[1]),
            offset=np.array(offset, np.float64),
            scale=np.array(resized, np.float64) / np.array(frame_size, np.float64),
        )

    def apply(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The input for a frame: resized, with grey bars."""
        width, height = self.input_size
        x, y = self.offset.astype(int).tolist()
        framed = np.full((height, width, 3), _GREY_LEVEL, np.uint8)
        small = cv2.resize(image, self.resized, interpolation=cv2.INTER_LINEAR)
        framed[y : y + self.resized[1], x : x + self.resized[0]] = small
        return framed

    def to_frame(self, boxes_xyxy_px: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
        """Boxes of the input as boxes of the frame, half-open, px."""
        return (boxes_xyxy_px - np.tile(self.offset, 2)) / np.tile(self.scale, 2)
