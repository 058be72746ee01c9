"""A candidate with the features that the tracker compares.

Histograms of the colours of their pixels measure how alike two views of fish look. Of seven cues
that were compared (mean colour, area, length, silhouette, picture patch, histograms of one and of
three channels), the joint histogram separates fish best; see docs/research/tracking.md.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from stream_dmr.detection.detector import Candidate
from stream_dmr.geometry import fraction_inside, oriented_extent, whole_pixels
from stream_dmr.segmentation.crop_geometry import touches_border

_BINS = 12  # of each channel of L*a*b*
_SMOOTHING_BINS = 0.8  # so that a slight change of light moves no pixel to a bin that counts as new
_OFFSETS = np.arange(_BINS) - np.arange(_BINS)[:, None]
_BLUR = np.exp(-0.5 * (_OFFSETS / _SMOOTHING_BINS) ** 2).astype(np.float32)
_MIN_ROOT_SHARE = 0.045  # of a bin that is a colour of the fish: 0.2 % of its pixels
_MIN_VISIBLE = 0.5  # of a silhouette that something covers
_SIDE_PX = 64  # of a larger picture every n-th pixel is enough


class Colours(NamedTuple):
    """Root histograms of one view of a fish."""

    silhouette: Float32[np.ndarray, "N"] | None  # None: only its box is known
    middle: Float32[np.ndarray, "N"]  # of an ellipse in the middle of its box


def colours_of(
    region: UInt8[np.ndarray, "h w 3"], silhouette: Bool[np.ndarray, "h w"] | None
) -> Colours:
    """Colours of a box and of the silhouette in it (BGR)."""
    own = None if silhouette is None else root_histogram(region, silhouette)
    return Colours(silhouette=own, middle=root_histogram(region, middle_of(*region.shape[:2])))


def middle_of(height: int, width: int) -> Bool[np.ndarray, "h w"]:
    """An ellipse in the middle of a box, without the background in the box's corners."""
    inside = np.zeros((height, width), np.uint8)
    center, axes = (width // 2, height // 2), (width // 3, height // 3)
    return cv2.ellipse(inside, center, axes, 0, 0, 360, 1, cv2.FILLED) > 0


def root_histogram(
    region: UInt8[np.ndarray, "h w 3"], silhouette: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "N"]:
    """Square roots of the shares of a silhouette's pixels by colour; zeros without pixels.

    `region` is BGR.
    """
    step = max(1, max(region.shape[:2]) // _SIDE_PX)
    lab = cv2.cvtColor(np.ascontiguousarray(region[::step, ::step]), cv2.COLOR_BGR2LAB)
    inside = np.ascontiguousarray(silhouette[::step, ::step]).astype(np.uint8)
    counts = cv2.calcHist([lab], [0, 1, 2], inside, [_BINS] * 3, [0, 256] * 3)
    for _ in range(3):  # along each axis in turn, which comes last then
        counts = np.tensordot(_BLUR, counts, (1, 2))
    return np.sqrt(counts / max(float(counts.sum()), 1e-6)).ravel()


def dissimilarity(a: Colours, b: Colours, *, is_cut_off: bool = False) -> float:
    """1 less the Bhattacharyya coefficient: 0 for equal colours, 1 for none in common.

    A silhouette and a mere box differ by the background behind the fish. In the open that is
    right: if motion loses a fish, the next box mostly shows another fish. For a fish that is
    `is_cut_off` by the picture's edge, which motion loses first, the middles are compared.
    """
    first, second = (view.middle if view.silhouette is None else view.silhouette for view in (a, b))
    if is_cut_off and (a.silhouette is None or b.silhouette is None):
        first, second = a.middle, b.middle
    return max(0.0, 1.0 - float(first @ second))


def dissimilarity_if_covered(a: Colours, b: Colours) -> float:
    """The same, without the colours of one view only: a gaff or a line covers part of a silhouette.

    1 if they are more than half of it, or if a view has no silhouette.
    """
    if a.silhouette is None or b.silhouette is None:
        return 1.0
    first, second = a.silhouette, b.silhouette
    return min(_without_cover(first, second), _without_cover(second, first))


def _without_cover(bare: Float32[np.ndarray, "N"], covered: Float32[np.ndarray, "N"]) -> float:
    """The dissimilarity if the second view has colours that the fish, in the first view, lacks."""
    own = bare > _MIN_ROOT_SHARE
    fish, seen = bare[own], covered[own]
    if seen @ seen < _MIN_VISIBLE:
        return 1.0
    return max(0.0, 1.0 - float(fish @ seen / np.sqrt((fish @ fish) * (seen @ seen))))


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
        """`whole`: the merged candidate of which this is a piece; None: not a piece."""
        self.candidate, self.whole, self.is_piece = candidate, whole, whole is not None
        self.box = candidate.bbox_xyxy_px
        self.center = (self.box[:2] + self.box[2:]) / 2
        x0, y0, x1, y1 = whole_pixels(self.box)
        silhouette = candidate.foreground
        if silhouette is None:
            silhouette = middle_of(y1 - y0, x1 - x0)
        self.area = float(max(1, np.count_nonzero(silhouette)))
        self.length = max(1.0, oriented_extent(silhouette)[1])  # a line of pixels has none
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
        return fraction_inside(self.box, box)
