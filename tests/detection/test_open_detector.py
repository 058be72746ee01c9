"""A detector's name or path opens it, or is refused; the shipped one knows fish by their looks."""

import numpy as np
import pytest

from stream_dmr.detection.open_detector import DetectFishSettings, open_detector
from stream_dmr.errors import ModelError
from stream_dmr.geometry import box_iou, fraction_inside
from stream_dmr.simulation.film import film
from stream_dmr.simulation.rail_scene import make_scene
from tests.support.frames import frame_of


def test_an_unknown_name_is_refused():
    with pytest.raises(
        ModelError, match=r'"unet" or a path that ends in \.pt or \.onnx, got "yolo"'
    ):
        open_detector(DetectFishSettings(detector="yolo"))


def test_fish_are_seen_where_nothing_moves_and_nothing_else_is():
    detector = open_detector(DetectFishSettings(detector="looks"))
    scene = make_scene(num_fish=1, num_frames=15, preset="clean", seed=3)
    shots = list(film(scene))
    whole = [shot for shot in shots if any(box.visible_fraction == 1 for box in shot.boxes)]
    assert len(whole) > 3
    num_found = num_loose = 0
    for shot in whole:
        x, y, w, h = shot.boxes[0].xywh_px
        truth = np.array([x, y, x + w, y + h], np.float64)
        found = detector.find(frame_of(shot.image, shot.frame_index))
        sure = [one.bbox_xyxy_px for one in found if one.score > 0.4]
        num_found += any(fraction_inside(truth, box) > 0.7 for box in sure)
        assert all(box_iou(box, truth) > 0.3 for box in sure)
        num_loose += sum(fraction_inside(box, truth) <= 0.5 for box in sure)  # and the line above
    assert num_found > 0.8 * len(whole)
    assert num_loose <= 0.1 * len(whole)
    empty = [shot for shot in shots if not shot.boxes]
    for shot in empty:
        found = detector.find(frame_of(shot.image, shot.frame_index))
        assert not any(one.score > 0.4 for one in found)
