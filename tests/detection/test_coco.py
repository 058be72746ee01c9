"""Boxes from COCO's JSON."""

import json
from pathlib import Path

import pytest

from stream_dmr.detection.box_files import UNKNOWN_ID, load_boxes, parse_coco
from stream_dmr.errors import AnnotationError
from tests.support.annotation_files import coco

PATH = Path("boxes.json")  # for messages


def test_frames_are_counted_in_the_natural_order_of_file_names():
    names = ["10.png", "9.png", "1.png"]
    text = json.dumps(
        {
            "images": [{"id": i, "file_name": name} for i, name in enumerate(names)],
            "annotations": [{"image_id": 0, "bbox": [1, 2, 3, 4], "score": 0.5}],
        }
    )
    frames = parse_coco(text, PATH)
    assert list(frames) == [3]
    assert (frames[3][0].track_id, frames[3][0].score) == (UNKNOWN_ID, 0.5)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "expected COCO's JSON"),
        ("[]", "expected COCO's JSON"),
        ('{"images": [{"id": 1}], "annotations": []}', "file_name"),
        ("[" * 100_000, "RecursionError"),
        (coco([]).replace("[]", '[{"image_id": 9, "bbox": [1,1,1,1]}]'), "annotation 1"),
        (coco([(1, 1, 1, 1, 5, 0)]), "annotation 1: expected a width and height above 0"),
        (coco([(1, 1, 1, 1, float("nan"), 2)]), "above 0, got nan x 2"),
        (coco([(1, 0, 1, 1, 5, 5)]), "annotation 1: expected the image_id"),
        (coco([(1, 1, 1, 1, 5, 5), (1, 1, 2, 2, 5, 5)]), "a second one of id 1 in frame"),
    ],
    ids=lambda value: value[:20],
)
def test_files_of_another_kind_are_refused(text: str, expected: str):
    with pytest.raises(AnnotationError) as caught:
        parse_coco(text, PATH)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_boxes_of_pictures_of_another_size_are_refused(tmp_path):
    image = {"id": 1, "file_name": "000001.png", "width": 640, "height": 480}
    box = {"id": 1, "image_id": 1, "bbox": [10, 20, 30, 40]}
    path = tmp_path / "boxes.json"
    path.write_text(json.dumps({"images": [image], "annotations": [box]}))
    (given,) = load_boxes(path)[1]
    given.in_px(640, 480)
    with pytest.raises(AnnotationError, match="of 1280x960 px, got those of 640x480 px"):
        given.in_px(1280, 960)
