"""Open a segmenter by its name, among them GrabCut, which has no trained weights.

Rother, Kolmogorov, Blake: "GrabCut: interactive foreground extraction using iterated graph cuts",
SIGGRAPH 2004. It follows colour, so shadows and lines may be taken for fish.
"""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stream_dmr.errors import ModelError
from stream_dmr.geometry import longer_side
from stream_dmr.segmentation.promptable_segmenter import PromptableSegmenter
from stream_dmr.segmentation.segmenter import SegmentedFish, Segmenter
from stream_dmr.segmentation.unet_segmenter import SHIPPED, UNetSegmenter, is_unet_file

# Chosen by hand.
_CONTEXT = 0.2  # of the box's longer side: the ring around it that shows the background
_WORKING_PX = 256  # of the longer side: finer costs much time and moves the outline little
_MIN_SIDE_PX = 12  # below, GrabCut's two mixtures of 5 Gaussians have too few pixels
_NUM_ITERATIONS = 5


class GrabCutSegmenter:
    """A `Segmenter` without weights, which locates no ends."""

    knows_fish = False

    def segment(
        self, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> SegmentedFish:
        """The fish in a box; its probability is 0 or 1, since GrabCut gives a binary mask."""
        mask = segment_box(image, bbox_xyxy_px)
        return SegmentedFish(probability=mask.astype(np.float32), ends=None)


def segment_box(
    image: UInt8[np.ndarray, "H W 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
) -> Bool[np.ndarray, "H W"]:
    """The fish in a box, as a mask of the whole image (BGR); empty if the box is too small.

    Deterministic, and independent of all other frames.
    """
    mask = np.zeros(image.shape[:2], bool)
    # The box and its surroundings in whole pixels, half-open, inside the frame.
    ring = _CONTEXT * longer_side(bbox_xyxy_px)
    x0, y0 = np.floor(bbox_xyxy_px[:2] - ring).astype(int).clip(0, mask.shape[::-1]).tolist()
    x1, y1 = np.ceil(bbox_xyxy_px[2:] + ring).astype(int).clip(0, mask.shape[::-1]).tolist()
    region = image[y0:y1, x0:x1]
    scale = min(1.0, _WORKING_PX / max(region.shape[0], region.shape[1], 1))
    box = np.round((bbox_xyxy_px - [x0, y0, x0, y0]) * scale).astype(int)
    if min(box[2] - box[0], box[3] - box[1], *region.shape[:2]) < _MIN_SIDE_PX:
        return mask
    small = cv2.resize(region, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    # The largest component, without threads and notches thinner than a few pixels.
    fish = cv2.medianBlur(_grab_cut(small, box), 5)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(fish, connectivity=4)
    if count > 1:
        fish = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    size = (region.shape[1], region.shape[0])
    mask[y0:y1, x0:x1] = cv2.resize(fish * np.uint8(255), size) > 127
    return mask


def _grab_cut(image: UInt8[np.ndarray, "h w 3"], box: np.ndarray) -> UInt8[np.ndarray, "h w"]:
    """1 for fish by GrabCut. Outside the box is background; its corners probably are."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = (int(v) for v in np.clip(box, 0, [width, height, width, height]))
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    labels[y0:y1, x0:x1] = cv2.GC_PR_BGD
    center = ((x0 + x1 - 1) / 2, (y0 + y1 - 1) / 2)
    cv2.ellipse(labels, (center, (x1 - x0, y1 - y0), 0.0), cv2.GC_PR_FGD, cv2.FILLED)
    cv2.setRNGSeed(0)  # its k-means starts at random
    models = np.zeros((2, 1, 65))  # of background and fish; OpenCV's workspace
    unused = (0, 0, 0, 0)
    cv2.grabCut(
        image, labels, unused, models[0], models[1], _NUM_ITERATIONS, mode=cv2.GC_INIT_WITH_MASK
    )
    return ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)


def open_segmenter(name: str) -> Segmenter:
    """The segmenter of a name, or of a path to an ONNX file or to weights (.pt).

    Torch is imported only for weights. Raises ModelError for an unknown name, and if the file
    cannot be used.
    """
    if name == "grabcut":
        return GrabCutSegmenter()
    suffix = Path(name).suffix.lower()
    if name == "unet":
        return UNetSegmenter.load(SHIPPED)
    if suffix == ".pt" or (suffix == ".onnx" and is_unet_file(Path(name))):
        return UNetSegmenter.load(Path(name))
    if suffix == ".onnx":
        return PromptableSegmenter(Path(name))
    raise ModelError(
        f'[crop_fish] segmenter: expected "unet", "grabcut" or a path that ends in .pt or .onnx, '
        f'got "{name}"'
    )
