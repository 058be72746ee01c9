"""Run the U-Net on crops and boxes. This is where a run imports torch.

`masks.open_segmenter` and `detection.open_detector` import this module only where the
configuration asks for the network.
"""

import copy
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from stream_dmr.segmentation.network.fish_ends import find_ends
from stream_dmr.segmentation.network.unet import UNet, normalise
from stream_dmr.segmentation.network.unet_interface import SIZE_PX, box_coverage
from stream_dmr.segmentation.network.unet_weights import load_weights
from stream_dmr.segmentation.segmenter import SegmentedFish


class UNetSegmenter:
    """A `Segmenter` that also locates the fish's ends."""

    def __init__(self, network: UNet, *, device: str = "cpu") -> None:
        """`network` stays as it is: a copy is optimised for inference."""
        self._device = torch.device(device)
        network = _without_batch_norm(network.eval()).to(self._device)
        self._network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @classmethod
    def load(cls, path: Path, *, device: str = "cpu") -> "UNetSegmenter":
        """Raises ModelError where the weights cannot be used."""
        return cls(load_weights(path), device=device)

    def segment(
        self, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> SegmentedFish:
        """The fish in a box, half-open in pixels of the crop `image` (BGR) of any size."""
        size = len(image)
        scale = SIZE_PX / size
        in_box = box_coverage(bbox_xyxy_px * scale, size=SIZE_PX)
        with _one_thread():
            probability, ends = self.segment_batch(_resize(image, SIZE_PX)[None], in_box[None])
        return SegmentedFish(
            probability=np.clip(_resize(probability[0], size), 0, 1),
            ends=find_ends(ends[0], scale=scale),
        )

    def segment_all(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
        """Probability of each pixel to be any fish; H and W are multiples of SIZE_MULTIPLE_PX."""
        with _one_thread():
            no_box = np.ones(image.shape[:2], np.float32)
            return self.segment_batch(image[None], no_box[None])[0][0]

    @torch.inference_mode()
    def segment_batch(
        self, images: UInt8[np.ndarray, "B H W 3"], in_boxes: Float32[np.ndarray, "B H W"]
    ) -> tuple[Float32[np.ndarray, "B H W"], Float32[np.ndarray, "B 2 h w"]]:
        """Probabilities of fish, and log probabilities of head and tail at a quarter of the size.

        H and W are multiples of SIZE_MULTIPLE_PX. `in_boxes` are from `box_coverage`; where it is 1
        everywhere, all fish in the image are found.
        """
        pictures = torch.from_numpy(images).to(self._device).float()
        boxes = torch.from_numpy(in_boxes).to(self._device)
        mask_logits, ends_logits = self._network(normalise(pictures, boxes))
        ends = torch.log_softmax(ends_logits.flatten(2), dim=2).reshape(ends_logits.shape)
        return torch.sigmoid(mask_logits).cpu().numpy(), ends.cpu().numpy()


@contextmanager
def _one_thread() -> Generator[None]:
    """Compute with one thread: the layers are too small to share, and other stages need the cores.

    With two threads on a busy machine a crop took 55 ms of processor time instead of 7.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _resize(picture: np.ndarray, size: int) -> np.ndarray:
    """A square picture in another size; pixel edges stay where they are, not pixel centers."""
    if len(picture) == size:
        return picture
    interpolation = cv2.INTER_AREA if len(picture) > size else cv2.INTER_LINEAR
    return cv2.resize(picture, (size, size), interpolation=interpolation)


def _without_batch_norm(network: UNet) -> UNet:
    """A copy with each batch normalisation folded into the convolution before it."""
    network = copy.deepcopy(network)
    for module in list(network.modules()):
        if isinstance(module, nn.Sequential) and len(module) > 1:
            convolution, normalisation = module[0], module[1]
            if isinstance(convolution, nn.Conv2d) and isinstance(normalisation, nn.BatchNorm2d):
                module[0] = fuse_conv_bn_eval(convolution, normalisation)
                module[1] = nn.Identity()
    return network
