"""Position, size and appearance of a detector's candidate, as the tracker compares them."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stream_dmr.segmentation.detection.detector import Candidate, fraction_inside, whole_pixels
from stream_dmr.segmentation.masks.crop_quality import touches_border
from stream_dmr.segmentation.tracking.appearance import colours_of, middle_of

_CUT_OFF = 0.08  # longer sides: a box of a network that ends so near to the border is cut by it


class Observation:
    """A candidate of one frame with its measured features; all lengths in frame pixels."""

    def __init__(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        candidate: Candidate,
        *,
        whole: Candidate | None = None,
    ) -> None:
        """`whole`: the merged candidate of which this one is a piece; None: not a piece."""
        self.candidate, self.whole, self.is_piece = candidate, whole, whole is not None
        self.box = candidate.bbox_xyxy_px
        self.center = (self.box[:2] + self.box[2:]) / 2
        x0, y0, x1, y1 = whole_pixels(self.box)
        silhouette = candidate.foreground
        if silhouette is None:
            silhouette = middle_of(y1 - y0, x1 - x0)
        self.area = float(max(1, np.count_nonzero(silhouette)))
        self.length = oriented_extent(silhouette)[1]
        region = image[y0:y1, x0:x1]
        inside = silhouette[: region.shape[0], : region.shape[1]]
        self.colours = colours_of(region, None if candidate.foreground is None else inside)
        reach = _CUT_OFF * max(x1 - x0, y1 - y0) if candidate.foreground is None else 0.0
        edges = np.array([x0 - reach, y0 - reach, x1 + reach, y1 + reach])
        self.touches_border = touches_border(edges, shape=image.shape[:2])

    @property
    def outer_box(self) -> Float[np.ndarray, "4"]:
        """The box of the whole candidate, for a piece; its own otherwise."""
        return self.box if self.whole is None else self.whole.bbox_xyxy_px

    def fraction_inside(self, box: Float[np.ndarray, "4"]) -> float:
        """The fraction of this observation's box that lies inside `box`."""
        return fraction_inside(self.box, box)


def oriented_extent(shape: Bool[np.ndarray, "H W"]) -> tuple[float, float]:
    """Width and length of the smallest rotated rectangle around a shape, px; zeros if empty."""
    # The outlines have the hull of all pixels, of which there are fifty times as many.
    outlines, _ = cv2.findContours(shape.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not outlines:
        return 0.0, 0.0
    sides = cv2.minAreaRect(np.concatenate(outlines))[1]
    return min(sides), max(sides)
