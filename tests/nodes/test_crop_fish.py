"""CropFish: every fish of a frame in a crop of its own."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from stream_dmr.camera import Camera
from stream_dmr.detection.box_files import AnnotatedBox
from stream_dmr.detection.given_fish import AnnotatedFish
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.segmentation.crop import CropFishSettings
from tests.support.frames import frame_of, grey_frame

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_TORCH = """
import sys
import cv2, numpy as np
from stream_dmr.messages import Frame
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.detection.given_fish import open_annotated_fish
from stream_dmr.segmentation.crop import CropFishSettings
mask = np.zeros((90, 120), np.uint8)
mask[20:60, 30:90] = 3
cv2.imwrite("000001.png", mask)
from pathlib import Path
finder = open_annotated_fish(boxes=None, masks=Path("."))
image = np.full((90, 120, 3), 128, np.uint8)
frame = Frame(frame_index=1, timestamp_ns=0, image=image, source="")
[crop] = CropFish(CropFishSettings(), camera=None, finder=finder).step(frame)
assert crop.track_id == 3 and crop.mask.any()
assert "torch" not in sys.modules, "torch was imported"
"""


def box_of(track_id: int, *xyxy: float, visibility: float = 1.0) -> AnnotatedBox:
    return AnnotatedBox(
        track_id=track_id, bbox_xyxy_px=np.array(xyxy, np.float64), visibility=visibility
    )


def test_every_fish_is_cropped_with_a_nominal_camera_where_none_is_given():
    boxes = {1: [box_of(2, 10, 10, 60, 30), box_of(5, 50, 20, 90, 70, visibility=0.4)]}
    settings = CropFishSettings(segmenter="grabcut")
    node = CropFish(settings, camera=None, finder=AnnotatedFish(boxes=boxes, masks=None))
    frame = grey_frame(Camera.nominal(width=120, height=90))
    first, second = node.step(frame)
    assert (first.track_id, second.track_id) == (2, 5)
    assert second.quality.visible_fraction == 0.4
    assert (first.frame_camera.width, first.frame_camera.height) == (120, 90)
    assert first.frame_camera is second.frame_camera
    assert first.image.shape == (128, 128, 3)
    assert node.step(frame_of(frame.image, 2)) == []
    assert [(end.track_id, end.cause) for end in node.close()] == [(2, "end"), (5, "end")]
    assert node.close() == []


def test_with_given_masks_torch_is_not_imported(tmp_path):
    command = [sys.executable, "-c", WITHOUT_TORCH]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
