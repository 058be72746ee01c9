"""Boxes from CVAT's XML."""

from pathlib import Path

import pytest

from stream_dmr.detection.box_files import UNKNOWN_ID, parse_cvat
from stream_dmr.errors import AnnotationError
from tests.support.annotation_files import cvat_corners, cvat_video

PATH = Path("boxes.xml")  # for messages


def test_boxes_of_pictures_have_no_ids():
    box = f"<box label='fish' {cvat_corners(1, 2, 30, 40)}/>"
    text = f"<annotations><image id='4' name='e.png'>{box}{box}</image></annotations>"
    frames = parse_cvat(text, PATH)
    assert {frame: [box.track_id for box in boxes] for frame, boxes in frames.items()} == {
        5: [UNKNOWN_ID, UNKNOWN_ID]
    }


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<annotations>", "expected CVAT's XML"),
        ("<svg/>", "expected CVAT's <annotations>, got <svg>"),
        ("<annotations><image id='0'><box xtl='1'/></image></annotations>", "image 0"),
        (cvat_video([(1, 1, 5, 5, -2, 5)]), "track 0, frame 0: expected a width"),
    ],
)
def test_files_of_another_kind_are_refused(text: str, expected: str):
    with pytest.raises(AnnotationError) as caught:
        parse_cvat(text, PATH)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


_PICTURE = (
    f"<annotations><image id='0' name='e.png' width='64' height='48'>"
    f"<box label='fish' {cvat_corners(1, 2, 30, 40)}/></image></annotations>"
)
_VIDEO = cvat_video([(1, 1, 5, 5, 20, 5)]).replace(
    "</version>",
    "</version><meta><job><original_size><width>64</width><height>48</height></original_size>"
    "</job></meta>",
)


@pytest.mark.parametrize("text", [_PICTURE, _VIDEO])
def test_boxes_of_pictures_of_another_size_are_refused(text: str):
    (box,) = parse_cvat(text, PATH)[1]
    assert box.in_px(64, 48) is box
    with pytest.raises(AnnotationError, match="got those of 64x48 px"):
        box.in_px(128, 96)
