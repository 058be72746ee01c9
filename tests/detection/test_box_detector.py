"""Boxes of a file without ids, as a detector gives them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.box_files import UNKNOWN_ID, AnnotatedBox
from stream_dmr.detection.given_fish import BoxDetector
from tests.support.frames import frame_of

IMAGE = np.zeros((80, 120, 3), np.uint8)
places, sides = st.floats(-200, 200), st.floats(0.1, 300)


@given(st.lists(st.tuples(places, places, sides, sides), max_size=4))
def test_boxes_are_clipped_to_the_frame_and_those_outside_are_dropped(table: list[tuple]):
    boxes = [
        AnnotatedBox(
            track_id=UNKNOWN_ID,
            bbox_xyxy_px=np.array([x, y, x + w, y + h]),
            visibility=1.0,
            score=0.5,
        )
        for x, y, w, h in table
    ]
    detector = BoxDetector({7: boxes})
    found = [candidate.bbox_xyxy_px for candidate in detector.find(frame_of(IMAGE, 7))]
    assert all((box[:2] >= 0).all() and (box[2:] <= [120, 80]).all() for box in found)
    visible = [(min(x + w, 120) - max(x, 0), min(y + h, 80) - max(y, 0)) for x, y, w, h in table]
    assert len(found) == sum(w >= 1 and h >= 1 for w, h in visible)
    assert detector.find(frame_of(IMAGE, 8)) == []
