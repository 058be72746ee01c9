"""Inputs, outputs and sizes of the U-Net, without torch."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

WEIGHTS = Path(__file__).parent / "weights"  # of the networks that ship
SIZES_PX = (128, 192, 256)  # width and height of the crops that it is trained on
SIZE_MULTIPLE_PX = 32  # of its input's width and height: it halves the input five times
ENDS_STRIDE = 4  # input pixels per cell of the maps of head and tail

# Names in its ONNX file.
IMAGES_INPUT, BOXES_INPUT = "images", "in_boxes"
MASK_OUTPUT, ENDS_OUTPUT = "probability", "log_ends"
MODEL_FORMAT = "stream-dmr unet 2"  # a new number if the network's layers change


def box_coverage(bbox_xyxy_px: Float[np.ndarray, "4"], *, size: int) -> Float32[np.ndarray, "S S"]:
    """The fraction of each pixel inside a box, 0 to 1; the box is half-open, in crop pixels.

    This is the network's fourth channel: which of several fish to segment.
    """
    starts = np.arange(size)
    x0, y0, x1, y1 = bbox_xyxy_px
    columns = np.clip(np.minimum(starts + 1, x1) - np.maximum(starts, x0), 0.0, 1.0)
    rows = np.clip(np.minimum(starts + 1, y1) - np.maximum(starts, y0), 0.0, 1.0)
    return np.outer(rows, columns).astype(np.float32)
