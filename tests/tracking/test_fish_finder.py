"""Files are used where they are given; fish without ids are tracked."""

from pathlib import Path

import numpy as np
import pytest

from stream_dmr.detection.given_fish import AnnotatedFish
from stream_dmr.detection.open_detector import DetectFishSettings
from stream_dmr.errors import ConfigError
from stream_dmr.messages import Frame
from stream_dmr.tracking.finder import TrackedFish, TrackFishSettings, open_finder


def finder(boxes: Path | None, masks: Path | None = None):
    settings = {"detect": DetectFishSettings(), "track": TrackFishSettings(min_track_frames=2)}
    return open_finder(boxes=boxes, masks=masks, **settings)


def test_boxes_with_ids_are_kept_and_others_are_tracked(tmp_path):
    named, unnamed = tmp_path / "named.txt", tmp_path / "unnamed.txt"
    named.write_text("".join(f"{f},7,{10 * f},20,50,30,1\n" for f in range(1, 9)))
    unnamed.write_text("".join(f"{f},-1,{10 * f},20,50,30,0.8,-1,-1,-1\n" for f in range(1, 9)))
    assert isinstance(finder(named), AnnotatedFish)
    assert isinstance(finder(None), TrackedFish)
    followed = finder(unnamed)
    assert isinstance(followed, TrackedFish)
    image = np.zeros((100, 200, 3), np.uint8)
    for f in range(1, 9):
        found = followed.detect(Frame(frame_index=f, timestamp_ns=f, image=image, source=""))
        expected = [(1, [10 * f, 20, 10 * f + 50, 50])]
        assert [(d.source_id, list(d.bbox_xyxy_px)) for d in found] == expected
        assert all(d.mask is None for d in found)


def test_boxes_of_stills_with_equal_ids_are_said(tmp_path):
    boxes = tmp_path / "boxes.txt"
    boxes.write_text("1,7,10,20,50,30,1\n2,7,10,20,50,30,1\n3,8,10,20,50,30,1\n")
    track = TrackFishSettings(across_frames=False)
    followed = open_finder(boxes=boxes, masks=None, detect=DetectFishSettings(), track=track)
    for f in (1, 2, 3):
        image = np.zeros((100, 200, 3), np.uint8)
        followed.detect(Frame(frame_index=f, timestamp_ns=f, image=image, source=""))
    (said,) = followed.warnings
    assert "id 7 in 2 pictures; where" in said


def test_motion_is_refused_where_no_picture_follows_another():
    track = TrackFishSettings(across_frames=False)
    with pytest.raises(ConfigError, match=r'set it to "looks"'):
        open_finder(boxes=None, masks=None, detect=DetectFishSettings(), track=track)
