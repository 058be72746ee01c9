"""Open the segmenter that `[crop_fish] segmenter` names."""

from pathlib import Path

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.masks.grabcut_segmenter import GrabCutSegmenter
from stream_dmr.segmentation.masks.promptable_segmenter import PromptableSegmenter
from stream_dmr.segmentation.network.unet_segmenter import SHIPPED, UNetSegmenter, is_unet_file
from stream_dmr.segmentation.segmenter import Segmenter


def open_segmenter(name: str) -> Segmenter:
    """The segmenter of a name, or of a path to an ONNX file or to weights (.pt).

    Torch is imported only for weights. Raises ModelError for an unknown name, and where the file
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
