"""The U-Net at work: crops and boxes in, probabilities and ends out."""

import copy
import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import permutations
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from stream_dmr.messages import FishEnds
from stream_dmr.segmentation.network.box_coverage import box_picture
from stream_dmr.segmentation.network.unet import ENDS_STRIDE, SIZE_PX, UNet, normalise
from stream_dmr.segmentation.network.unet_weights import load_weights
from stream_dmr.segmentation.segmenter import SegmentedFish

_LEAST_APART = 3.0  # cells between head and tail
_PEAK_REACH = 2  # cells around a map's peak whose mean says where it is between the cells


class UNetSegmenter:
    """A `Segmenter` that also sees the fish's ends."""

    def __init__(self, network: UNet, *, device: str = "cpu") -> None:
        self._device = torch.device(device)
        network = _fuse(network.eval()).to(self._device)
        self._network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @classmethod
    def load(cls, path: Path, *, device: str = "cpu") -> "UNetSegmenter":
        """Raises ModelError where the weights can't be used."""
        return cls(load_weights(path), device=device)

    def segment(
        self, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> SegmentedFish:
        """The fish in a box, half-open in pixels of the crop `image` (BGR) of any size."""
        size = len(image)
        scale = SIZE_PX / size
        in_box = box_picture(bbox_xyxy_px * scale, size=SIZE_PX)
        with _one_thread():
            probability, ends = self.segment_batch(_resize(image, SIZE_PX)[None], in_box[None])
        return SegmentedFish(
            probability=np.clip(_resize(probability[0], size), 0, 1),
            ends=_find_ends(ends[0], scale=scale),
        )

    def look(self, picture: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
        """Probabilities of being any fish; H and W are multiples of 16."""
        with _one_thread():
            nowhere = np.ones(picture.shape[:2], np.float32)
            return self.segment_batch(picture[None], nowhere[None])[0][0]

    @torch.inference_mode()
    def segment_batch(
        self, images: UInt8[np.ndarray, "B H W 3"], in_boxes: Float32[np.ndarray, "B H W"]
    ) -> tuple[Float32[np.ndarray, "B H W"], Float32[np.ndarray, "B 2 h w"]]:
        """Probabilities of fish, and log probabilities of head and tail at a quarter of the size.

        H and W are multiples of 16; the network was taught at 128. A picture whose `in_boxes` (see
        `boxes.box_picture`) is 1 everywhere has no box: then every fish in it is found.
        """
        pictures = torch.from_numpy(images).to(self._device).float()
        boxes = torch.from_numpy(in_boxes).to(self._device)
        mask_logits, ends_logits = self._network(normalise(pictures, boxes))
        ends = torch.log_softmax(ends_logits.flatten(2), dim=2).reshape(ends_logits.shape)
        return torch.sigmoid(mask_logits).cpu().numpy(), ends.cpu().numpy()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute with one thread: the layers are too small to share, and the other stages want cores.

    With two threads and a busy machine a crop took 55 ms of processor time instead of 7.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _find_ends(maps: Float32[np.ndarray, "2 s s"], *, scale: float) -> FishEnds:
    """The likeliest two places, in crop pixels; `scale` is network pixels per crop pixel.

    `maps` are log probabilities of head and tail. The odds against the two being the other way
    round are p_h(H) p_t(T) / (p_h(T) p_t(H)).
    """
    cells = [cell for one in maps for cell in _peaks(one)]
    value, head, tail = max(
        (float(maps[0][h] + maps[1][t]), h, t)
        for h, t in permutations(cells, 2)
        if math.dist(h, t) >= _LEAST_APART
    )
    log_odds = min(value - float(maps[0][tail] + maps[1][head]), 50.0)
    places = np.array([_refine(maps[0], head), _refine(maps[1], tail)])
    head_px, tail_px = ((places + 0.5) * ENDS_STRIDE) / scale - 0.5
    confidence = 1 / (1 + math.exp(-log_odds))
    return FishEnds(head_px=head_px, tail_px=tail_px, confidence=confidence)


def _peaks(log_probability: Float32[np.ndarray, "s s"]) -> list[tuple[int, int]]:
    """Row and column of the highest cell, and of the highest one away from it."""
    rows, columns = np.indices(log_probability.shape)
    first = divmod(int(log_probability.argmax()), len(log_probability))
    is_near = np.hypot(rows - first[0], columns - first[1]) < _LEAST_APART
    second = divmod(int(np.where(is_near, -np.inf, log_probability).argmax()), len(is_near))
    return [first, second]


def _refine(
    log_probability: Float32[np.ndarray, "s s"], cell: tuple[int, int]
) -> Float[np.ndarray, "2"]:
    """Column and row of a peak between the cells: the mean of those around it."""
    row, column = cell
    top, left = max(0, row - _PEAK_REACH), max(0, column - _PEAK_REACH)
    around = log_probability[top : row + _PEAK_REACH + 1, left : column + _PEAK_REACH + 1]
    weights = np.exp((around - around.max()).astype(np.float64))
    rows, columns = np.indices(weights.shape)
    total = weights.sum()
    return np.array(
        [left + (columns * weights).sum() / total, top + (rows * weights).sum() / total]
    )


def _resize(picture: np.ndarray, size: int) -> np.ndarray:
    """A square picture in another size; pixel edges stay where they are, not pixel centres."""
    if len(picture) == size:
        return picture
    way = cv2.INTER_AREA if len(picture) > size else cv2.INTER_LINEAR
    return cv2.resize(picture, (size, size), interpolation=way)


def _fuse(network: UNet) -> UNet:
    """A copy with each batch normalisation folded into the convolution before it."""
    network = copy.deepcopy(network)
    for module in list(network.modules()):
        if isinstance(module, nn.Sequential) and len(module) > 1:
            convolution, normalisation = module[0], module[1]
            if isinstance(convolution, nn.Conv2d) and isinstance(normalisation, nn.BatchNorm2d):
                module[0] = fuse_conv_bn_eval(convolution, normalisation)
                module[1] = nn.Identity()
    return network
