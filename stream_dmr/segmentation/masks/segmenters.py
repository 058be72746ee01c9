"""Which segmenter a name in the configuration means."""

from pathlib import Path

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.masks.grabcut import GrabCut
from stream_dmr.segmentation.segmenter import Segmenter


def open_segmenter(name: str) -> Segmenter:
    """The segmenter of `[crop_fish] segmenter`: a name, or a path to weights or to an ONNX file.

    Raises ModelError for another name, and where the file can't be used.
    """
    if name == "grabcut":
        return GrabCut()
    suffix = Path(name).suffix.lower()
    if name == "unet" or suffix == ".pt":
        from stream_dmr.segmentation.network.inference import UNetSegmenter
        from stream_dmr.segmentation.network.weights import SHIPPED

        return UNetSegmenter.load(SHIPPED if name == "unet" else Path(name))
    if suffix == ".onnx":
        from stream_dmr.segmentation.masks.promptable import PromptableModel

        return PromptableModel(Path(name))
    raise ModelError(
        f'[crop_fish] segmenter: expected "unet", "grabcut" or a path that ends in .pt or .onnx, '
        f'got "{name}"'
    )
