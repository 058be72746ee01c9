"""Which detector a name in the configuration means."""

from pathlib import Path

from pydantic import Field

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.detector import Detector
from stream_dmr.segmentation.motion import MotionDetector, MotionSettings
from stream_dmr.segmentation.onnx_detector import OnnxDetector, OnnxSettings
from stream_dmr.settings import Settings


class DetectorSettings(Settings):
    """The part of `[detect_fish]` that says who looks for fish."""

    detector: str = Field(
        default="motion",
        min_length=1,
        description='what finds fish in the picture: "motion", or a detector\'s file (.onnx)',
    )


class DetectFishSettings(OnnxSettings, MotionSettings, DetectorSettings):
    """`[detect_fish]`: how fish are found in a video that comes without boxes and masks."""


def open_detector(settings: DetectFishSettings) -> Detector:
    """The detector of `[detect_fish] detector`: a name, or a path to an ONNX file.

    Raises ModelError for another name, and where the file can't be used.
    """
    if settings.detector == "motion":
        return MotionDetector(settings)
    if Path(settings.detector).suffix.lower() == ".onnx":
        return OnnxDetector(Path(settings.detector), settings)
    raise ModelError(
        f'[detect_fish] detector: expected "motion" or a path that ends in .onnx, '
        f'got "{settings.detector}"'
    )
