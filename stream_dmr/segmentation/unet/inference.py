"""The U-Net at work: crops and boxes in, probabilities and ends out."""

import copy
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from stream_dmr.messages import FishEnds
from stream_dmr.segmentation.segmenter import Segmented
from stream_dmr.segmentation.unet.boxes import box_picture
from stream_dmr.segmentation.unet.network import ENDS_STRIDE, SIZE_PX, UNet, normalise
from stream_dmr.segmentation.unet.weights import load_weights

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
    ) -> Segmented:
        """The fish in a box, half-open in pixels of the crop `image` (BGR) of any size."""
        size = len(image)
        scale = SIZE_PX / size
        in_box = box_picture(bbox_xyxy_px * scale, size=SIZE_PX)
        probability, ends = self.segment_batch(_resize(image, SIZE_PX)[None], in_box[None])
        return Segmented(
            probability=np.clip(_resize(probability[0], size), 0, 1),
            ends=_find_ends(ends[0], scale=scale),
        )

    @torch.inference_mode()
    def segment_batch(
        self, images: UInt8[np.ndarray, "B S S 3"], in_boxes: Float32[np.ndarray, "B S S"]
    ) -> tuple[Float32[np.ndarray, "B S S"], Float32[np.ndarray, "B 2 s s"]]:
        """Probabilities of fish, and log probabilities of head and tail at a quarter of the size.

        S is a multiple of 16; the network was taught at 128. A picture whose `in_boxes` (see
        `boxes.box_picture`) is 1 everywhere has no box: then every fish in it is found.
        """
        pictures = torch.from_numpy(images).to(self._device).float()
        boxes = torch.from_numpy(in_boxes).to(self._device)
        mask_logits, ends_logits = self._network(normalise(pictures, boxes))
        ends = torch.log_softmax(ends_logits.flatten(2), dim=2).reshape(ends_logits.shape)
        return torch.sigmoid(mask_logits).cpu().numpy(), ends.cpu().numpy()


def _find_ends(maps: Float32[np.ndarray, "2 s s"], *, scale: float) -> FishEnds:
    """The peaks of both maps, in crop pixels; `scale` is network pixels per crop pixel.

    The odds against the two being the other way round are p_h(H) p_t(T) / (p_h(T) p_t(H)).
    """
    cells = np.array([_peak(one) for one in maps])  # x, y
    columns, rows = np.round(cells).astype(int).T
    at = maps[:, rows, columns]  # map by place
    log_odds = float(at[0, 0] + at[1, 1] - at[0, 1] - at[1, 0])
    if log_odds < 0:
        cells, log_odds = cells[::-1], -log_odds
    head, tail = ((cells + 0.5) * ENDS_STRIDE) / scale - 0.5
    confidence = 1 / (1 + float(np.exp(-min(log_odds, 50.0))))
    return FishEnds(head_px=head, tail_px=tail, confidence=confidence)


def _peak(log_probability: Float32[np.ndarray, "s s"]) -> Float[np.ndarray, "2"]:
    """Column and row of the highest cell, refined by the mean of those around it."""
    row, column = np.unravel_index(int(log_probability.argmax()), log_probability.shape)
    top, left = max(0, int(row) - _PEAK_REACH), max(0, int(column) - _PEAK_REACH)
    around = np.exp(
        log_probability[top : int(row) + _PEAK_REACH + 1, left : int(column) + _PEAK_REACH + 1]
    ).astype(np.float64)
    rows, columns = np.indices(around.shape)
    total = around.sum()
    return np.array([left + (columns * around).sum() / total, top + (rows * around).sum() / total])


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
