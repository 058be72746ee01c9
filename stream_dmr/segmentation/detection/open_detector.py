"""Open the detector that `[detect_fish] detector` names."""

from functools import partial
from pathlib import Path

from pydantic import Field

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.detection.detector import Detector
from stream_dmr.segmentation.detection.fused_detector import FusedDetector
from stream_dmr.segmentation.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.segmentation.detection.onnx_detector import OnnxDetector, OnnxSettings
from stream_dmr.segmentation.detection.unet_detector import UNetDetector
from stream_dmr.segmentation.network.unet_segmenter import SHIPPED, UNetSegmenter, is_unet_file
from stream_dmr.settings import Settings


class DetectorSettings(Settings):
    """The part of `[detect_fish]` that names the detector."""

    detector: str = Field(
        default="motion",
        min_length=1,
        description='what finds fish in the picture: "motion", "unet", a network of '
        "`stream-dmr train` (.onnx), or a detector's file (.onnx)",
    )


class UNetDetectorSettings(Settings):
    """The part of `[detect_fish]` that the detector "unet" reads."""

    unet_working_px: int = Field(
        default=256, ge=64, le=2048, description="longer side of the network's input, px"
    )


class DetectFishSettings(OnnxSettings, UNetDetectorSettings, MotionSettings, DetectorSettings):
    """`[detect_fish]`: how fish are found in a video that comes without boxes and masks."""


def open_detector(settings: DetectFishSettings) -> Detector:
    """The detector of a name, or of a path to an ONNX file or to weights (.pt).

    Torch is imported only for weights. Raises ModelError for an unknown name, and where the file
    cannot be used.
    """
    if settings.detector == "motion":
        return FusedDetector(MotionDetector(settings), partial(_open_unet, SHIPPED, settings))
    suffix = Path(settings.detector).suffix.lower()
    path = SHIPPED if settings.detector == "unet" else Path(settings.detector)
    if path == SHIPPED or suffix == ".pt" or (suffix == ".onnx" and is_unet_file(path)):
        return _open_unet(path, settings)
    if suffix == ".onnx":
        return OnnxDetector(Path(settings.detector), settings)
    raise ModelError(
        f'[detect_fish] detector: expected "motion", "unet" or a path that ends in .pt or .onnx, '
        f'got "{settings.detector}"'
    )


def _open_unet(path: Path, settings: UNetDetectorSettings) -> UNetDetector:
    return UNetDetector(UNetSegmenter.load(path), longer_px=settings.unet_working_px)
