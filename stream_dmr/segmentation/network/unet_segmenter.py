"""Run the U-Net on crops and boxes, by onnxruntime."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.network.fish_ends import find_ends
from stream_dmr.segmentation.network.onnx_session import open_session
from stream_dmr.segmentation.network.unet_interface import (
    BOXES_INPUT,
    ENDS_OUTPUT,
    IMAGES_INPUT,
    MASK_OUTPUT,
    MODEL_FORMAT,
    box_coverage,
)
from stream_dmr.segmentation.segmenter import SegmentedFish

SHIPPED = Path(__file__).parent / "weights" / "unet.onnx"
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

        Raises ModelError where the file cannot be used.
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

        H and W are multiples of SIZE_MULTIPLE_PX. `in_boxes` are from `box_coverage`; where it is 1
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
    from stream_dmr.segmentation.network.unet_export import unet_as_onnx
    from stream_dmr.segmentation.network.unet_weights import load_weights

    return unet_as_onnx(load_weights(path))
