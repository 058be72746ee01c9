"""Open the detector that `[detect_fish] detector` names."""

from pathlib import Path

from pydantic import Field

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.detection.detector import Detector
from stream_dmr.segmentation.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.segmentation.detection.onnx_detector import OnnxDetector, OnnxSettings
from stream_dmr.settings import Settings


class DetectorSettings(Settings):
    """The part of `[detect_fish]` that names the detector."""

    detector: str = Field(
        default="motion",
        min_length=1,
        description='what finds fish in the picture: "motion", "unet", weights of '
        "`stream-dmr train` (.pt), or a detector's file (.onnx)",
    )


class UNetDetectorSettings(Settings):
    """The part of `[detect_fish]` that the detector "unet" reads."""

    unet_working_px: int = Field(
        default=256, ge=64, le=2048, description="longer side of the network's input, px"
    )


class DetectFishSettings(OnnxSettings, UNetDetectorSettings, MotionSettings, DetectorSettings):
    """`[detect_fish]`: how fish are found in a video that comes without boxes and masks."""


def open_detector(settings: DetectFishSettings) -> Detector:
    """The detector of a name, or of a path to weights (.pt) or to an ONNX file.

    Torch is imported only where the U-Net is asked for. Raises ModelError for an unknown name, and
    where the file cannot be used.
    """
    if settings.detector == "motion":
        return MotionDetector(settings)
    suffix = Path(settings.detector).suffix.lower()
    if settings.detector == "unet" or suffix == ".pt":
        from stream_dmr.segmentation.detection.unet_detector import UNetDetector
        from stream_dmr.segmentation.network.unet_segmenter import UNetSegmenter
        from stream_dmr.segmentation.network.unet_weights import SHIPPED

        weights = SHIPPED if settings.detector == "unet" else Path(settings.detector)
        return UNetDetector(UNetSegmenter.load(weights), longer_px=settings.unet_working_px)
    if suffix == ".onnx":
        return OnnxDetector(Path(settings.detector), settings)
    raise ModelError(
        f'[detect_fish] detector: expected "motion", "unet" or a path that ends in .pt or .onnx, '
        f'got "{settings.detector}"'
    )
