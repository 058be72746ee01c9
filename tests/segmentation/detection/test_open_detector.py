"""A detector's name or path opens it, or is refused."""

import pytest

from stream_dmr.errors import ModelError
from stream_dmr.segmentation.detection.open_detector import DetectFishSettings, open_detector


def test_an_unknown_name_is_refused():
    with pytest.raises(
        ModelError, match=r'"unet" or a path that ends in \.pt or \.onnx, got "yolo"'
    ):
        open_detector(DetectFishSettings(detector="yolo"))
