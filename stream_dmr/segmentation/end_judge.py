"""A small network that sees whether a mask has both ends of its fish.

A mask ends where the box ends, or where a tail is as dark as the ground, and the segmenter is no
less sure of it. The judge looks at the picture and the mask together: at a stem without its fin, a
head without its snout, a body that goes on beyond the mask's edge.
"""

from functools import cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stream_dmr.geometry import long_axis
from stream_dmr.networks.onnx_session import open_session
from stream_dmr.networks.unet_interface import WEIGHTS

WIDTH_PX, HEIGHT_PX = 128, 64  # of what the network sees
_LENGTH_PX = 96.0  # of a mask in it
_FEWEST = 3  # pixels of a mask that has a direction
# Area over the length squared: 97 in 100 fish that the network learnt from have more. To those with
# less, eels and gars, it says that an end is missing.
_THINNEST = 0.09
_FINE = 1.4  # picture pixels to one of the network's, from which on they are averaged


def missing_end(image: UInt8[np.ndarray, "S S 3"], mask: Bool[np.ndarray, "S S"]) -> float | None:
    """Probability that the mask of a crop (BGR) lacks some of its fish.

    1 if it is empty; None if it is thinner than the fish that the network knows.
    """
    if np.count_nonzero(mask) < _FEWEST:
        return 1.0
    seen = end_picture(image, mask)
    if np.count_nonzero(seen[..., 3] > 127) < _THINNEST * _LENGTH_PX**2:
        return None
    # Each end to the right, and each upside down.
    looks = np.stack([seen, seen[:, ::-1], seen[::-1], seen[::-1, ::-1]])
    log_odds = _network().run(None, {"ends": looks})[0][:, 0].reshape(2, 2).mean(axis=0)
    return float(1 / (1 + np.exp(-log_odds.max())))


@cache
def _network() -> Any:
    """The session of what `benchmarks.segmentation.end_training` wrote."""
    return open_session(WEIGHTS / "ends.onnx", threads=1)


def end_picture(
    image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "64 128 4"]:
    """The picture (BGR) and the mask, turned and scaled so that the mask lies across the middle."""
    affine = upright(mask, length_px=_LENGTH_PX, size_px=(WIDTH_PX, HEIGHT_PX))
    step = 1 / float(np.hypot(*affine[0, :2]))
    if step > _FINE:
        image = cv2.GaussianBlur(image, (0, 0), 0.4 * step)
    size = (WIDTH_PX, HEIGHT_PX)
    seen = cv2.warpAffine(image, affine, size, borderMode=cv2.BORDER_REFLECT_101)
    layer = mask.view(np.uint8) * np.uint8(255)
    return np.dstack([seen, cv2.warpAffine(layer, affine, size)])


def upright(
    mask: Bool[np.ndarray, "H W"], *, length_px: float, size_px: tuple[int, int]
) -> Float[np.ndarray, "2 3"]:
    """The affine map to a picture in which a mask lies across the middle, `length_px` long.

    The long axis is that of its second moments, from left to right.
    """
    rows, columns = np.nonzero(mask)
    points = np.column_stack([columns, rows]).astype(np.float64)
    along = long_axis(points)
    along *= 1.0 if along[0] >= 0 else -1.0
    axes = np.stack([along, [-along[1], along[0]]])
    low, high = (points @ axes.T).min(axis=0), (points @ axes.T).max(axis=0)
    scale = length_px / max(high[0] - low[0], 1.0)
    shift = np.array(size_px) / 2 - scale * (low + high) / 2
    return np.column_stack([scale * axes, shift])
