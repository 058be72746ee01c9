"""Open the segmenter that `[crop_fish] segmenter` names."""

from pathlib import Path

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.masks.grabcut_segmenter import GrabCutSegmenter
from stream_dmr.segmentation.segmenter import Segmenter


def open_segmenter(name: str) -> Segmenter:
    """The segmenter of a name, or of a path to weights (.pt) or to an ONNX file.

    Torch is imported only where the U-Net is asked for. Raises ModelError for an unknown name, and
    where the file cannot be used.
    """
    if name == "grabcut":
        return GrabCutSegmenter()
    suffix = Path(name).suffix.lower()
    if name == "unet" or suffix == ".pt":
        from stream_dmr.segmentation.network.unet_segmenter import UNetSegmenter
        from stream_dmr.segmentation.network.unet_weights import SHIPPED

        return UNetSegmenter.load(SHIPPED if name == "unet" else Path(name))
    if suffix == ".onnx":
        from stream_dmr.segmentation.masks.promptable_segmenter import PromptableSegmenter

        return PromptableSegmenter(Path(name))
    raise ModelError(
        f'[crop_fish] segmenter: expected "unet", "grabcut" or a path that ends in .pt or .onnx, '
        f'got "{name}"'
    )
