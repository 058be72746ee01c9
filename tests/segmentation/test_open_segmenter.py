"""A segmenter's name or path opens it, or is refused."""

import pytest

from stream_dmr.detection.given_fish import AnnotatedFish
from stream_dmr.errors import ModelError
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.segmentation.crop import CropFishSettings
from stream_dmr.segmentation.open_segmenter import GrabCutSegmenter, open_segmenter


def test_unknown_names_and_unusable_files_are_refused(tmp_path):
    (tmp_path / "text.onnx").write_text("no model")
    for name in ("sam", "unet.onx", str(tmp_path / "text.onnx"), str(tmp_path / "none.onnx")):
        settings = CropFishSettings(segmenter=name)
        with pytest.raises(ModelError, match="expected"):
            CropFish(settings, camera=None, finder=AnnotatedFish(boxes={}, masks=None))


def test_grabcut_needs_no_file():
    assert isinstance(open_segmenter("grabcut"), GrabCutSegmenter)
