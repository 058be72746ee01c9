"""Open the detector that `[detect_fish] detector` names."""

from pathlib import Path

from pydantic import Field

from stream_dmr.detection.detector import Detector
from stream_dmr.detection.fused_detector import FusedDetector, LookSettings
from stream_dmr.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.detection.network_detectors import OnnxDetector, OnnxSettings, UNetDetector
from stream_dmr.errors import ModelError
from stream_dmr.networks.unet_interface import WEIGHTS
from stream_dmr.segmentation.unet_segmenter import SHIPPED, UNetSegmenter, is_unet_file
from stream_dmr.settings import Settings

_LOOKS_THREADS = 1  # two take 9.6 ms of the cores instead of 5.2, which other stages need
_LOOKS = WEIGHTS / "fish.onnx"
# Least score of a box that may be a fish. Nearly all simulated fish have more in most frames; see
# docs/research/tracking.md.
_MIN_LOOKS = 0.15


class DetectorSettings(Settings):
    """The part of `[detect_fish]` that names the detector."""

    detector: str = Field(
        default="motion",
        min_length=1,
        description='what finds fish in the picture: "motion" (and looks), "looks", "unet", a '
        "network of `stream-dmr train` (.onnx), or a detector's file (.onnx)",
    )


class UNetDetectorSettings(Settings):
    """The part of `[detect_fish]` that the detector "unet" reads."""

    unet_working_px: int = Field(
        default=256, ge=64, le=2048, description="longer side of the network's input, px"
    )


class DetectFishSettings(
    OnnxSettings, UNetDetectorSettings, MotionSettings, LookSettings, DetectorSettings
):
    """`[detect_fish]`: how fish are found in a video that comes without boxes and masks."""


def open_detector(settings: DetectFishSettings) -> Detector:
    """The detector of a name, or of a path to an ONNX file or to weights (.pt).

    Torch is imported only for weights. Raises ModelError for an unknown name, and if the file
    cannot be used.
    """
    if settings.detector == "motion":
        return FusedDetector(MotionDetector(settings), _open_looks(), settings)
    if settings.detector == "looks":
        return _open_looks()
    suffix = Path(settings.detector).suffix.lower()
    path = SHIPPED if settings.detector == "unet" else Path(settings.detector)
    if path == SHIPPED or suffix == ".pt" or (suffix == ".onnx" and is_unet_file(path)):
        return UNetDetector(UNetSegmenter.load(path), longer_px=settings.unet_working_px)
    if suffix == ".onnx":
        return OnnxDetector(Path(settings.detector), settings)
    raise ModelError(
        '[detect_fish] detector: expected "motion", "looks", "unet" or a path that ends in .pt or '
        f'.onnx, got "{settings.detector}"'
    )


def _open_looks() -> OnnxDetector:
    """The detector that ships, see docs/model-card.md."""
    settings = OnnxSettings(onnx_layout="yolov5")
    return OnnxDetector(_LOOKS, settings, min_score=_MIN_LOOKS, threads=_LOOKS_THREADS)
