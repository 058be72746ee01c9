"""The U-Net as a segmenter: masks and ends of fish."""

import math
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.errors import ModelError, requires_extra
from stream_dmr.messages import FishEnds
from stream_dmr.networks.onnx_session import open_session
from stream_dmr.networks.unet_interface import (
    BOXES_INPUT,
    ENDS_OUTPUT,
    ENDS_STRIDE,
    IMAGES_INPUT,
    MASK_OUTPUT,
    MODEL_FORMAT,
    WEIGHTS,
    box_coverage,
)
from stream_dmr.segmentation.segmenter import SegmentedFish

_MIN_DISTANCE = 3.0  # cells between head and tail: three of the training target's spreads
_NEAR = 2  # rows and columns: of the cells this near all are nearer than that
_PEAK_RADIUS = 2  # cells around a peak whose mean locates it between the cells
_MAX_LOG_ODDS = 50.0  # keeps the exponential finite; the confidence is 1 long before


def find_ends(maps: Float32[np.ndarray, "2 s s"]) -> FishEnds:
    """The most probable pair of head and tail, in pixels of the picture that the network saw.

    `maps` are log probabilities of head and tail per cell. The odds against the two being swapped
    are p_h(H) p_t(T) / (p_h(T) p_t(H)).
    """
    cells = [cell for log_probability in maps for cell in _peaks(log_probability)]
    value, head, tail = max(
        (float(maps[0][h] + maps[1][t]), h, t)
        for h, t in permutations(cells, 2)
        if math.dist(h, t) >= _MIN_DISTANCE
    )
    log_odds = min(value - float(maps[0][tail] + maps[1][head]), _MAX_LOG_ODDS)
    cells_xy = np.array([_refine(maps[0], head), _refine(maps[1], tail)])
    head_px, tail_px = (cells_xy + 0.5) * ENDS_STRIDE - 0.5
    confidence = 1 / (1 + math.exp(-log_odds))
    return FishEnds(head_px=head_px, tail_px=tail_px, confidence=confidence)


def _peaks(log_probability: Float32[np.ndarray, "s s"]) -> list[tuple[int, int]]:
    """Row and column of the highest cell, and of the highest cell away from it."""
    row, column = divmod(int(log_probability.argmax()), len(log_probability))
    away = log_probability.copy()
    top, left = max(0, row - _NEAR), max(0, column - _NEAR)
    away[top : row + _NEAR + 1, left : column + _NEAR + 1] = -np.inf
    return [(row, column), divmod(int(away.argmax()), len(away))]


def _refine(
    log_probability: Float32[np.ndarray, "s s"], cell: tuple[int, int]
) -> Float[np.ndarray, "2"]:
    """Column and row of a peak between the cells: the mean of those around it."""
    row, column = cell
    top, left = max(0, row - _PEAK_RADIUS), max(0, column - _PEAK_RADIUS)
    around = log_probability[top : row + _PEAK_RADIUS + 1, left : column + _PEAK_RADIUS + 1]
    weights = np.exp((around - around.max()).astype(np.float64))
    rows, columns = np.indices(weights.shape)
    x, y = ((places * weights).sum() / weights.sum() for places in (columns, rows))
    return np.array([left + x, top + y])


SHIPPED = WEIGHTS / "unet.onnx"
_THREADS = 1  # the layers are too small to share, and other stages need the cores


class UNetSegmenter:
    """A `Segmenter` that also locates the fish's ends."""

    knows_fish = True

    def __init__(self, session: Any) -> None:
        """`session` is onnxruntime's, of a model by `unet_export`."""
        self._session = session

    @classmethod
    def load(cls, path: Path) -> "UNetSegmenter":
        """The network of an ONNX file, or of weights (.pt), which imports torch to convert them.

        Raises ModelError if the file cannot be used.
        """
        content = _convert(path) if path.suffix.lower() == ".pt" else None
        session = open_session(path, content=content, threads=_THREADS)
        if not _is_unet(session):
            raise ModelError(
                f"{path}: expected a network in the format '{MODEL_FORMAT}', got another one; "
                "train it again"
            )
        return cls(session)

    def segment(
        self, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> SegmentedFish:
        """The fish in a box, half-open in pixels of the crop `image` (BGR).

        S is a multiple of SIZE_MULTIPLE_PX.
        """
        in_box = box_coverage(bbox_xyxy_px, size=len(image))
        probability, ends = self.segment_batch(image[None], in_box[None])
        return SegmentedFish(probability=probability[0], ends=find_ends(ends[0]))

    def segment_all(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
        """Probability of each pixel to be any fish; H and W are multiples of SIZE_MULTIPLE_PX."""
        no_box = np.ones(image.shape[:2], np.float32)
        return self.segment_batch(image[None], no_box[None])[0][0]

    def segment_batch(
        self, images: UInt8[np.ndarray, "B H W 3"], in_boxes: Float32[np.ndarray, "B H W"]
    ) -> tuple[Float32[np.ndarray, "B H W"], Float32[np.ndarray, "B 2 h w"]]:
        """Probabilities of fish, and log probabilities of head and tail at a quarter of the size.

        H and W are multiples of SIZE_MULTIPLE_PX. `in_boxes` are from `box_coverage`; if it is 1
        everywhere, all fish in the image are found.
        """
        feed = {IMAGES_INPUT: np.ascontiguousarray(images), BOXES_INPUT: in_boxes}
        return tuple(self._session.run([MASK_OUTPUT, ENDS_OUTPUT], feed))


def is_unet_file(path: Path) -> bool:
    """True for an ONNX file of this version's network. Raises ModelError for no or another file."""
    return _is_unet(open_session(path))


def _is_unet(session: Any) -> bool:
    return session.get_modelmeta().custom_metadata_map.get("format") == MODEL_FORMAT


def _convert(path: Path) -> bytes:
    with requires_extra("torch", f"{path}: weights"):
        from stream_dmr.networks.unet import load_weights, unet_as_onnx

    return unet_as_onnx(load_weights(path))
