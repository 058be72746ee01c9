"""Boxes from COCO and CVAT files, and detections without ids that are followed."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import AnnotationError
from stream_dmr.messages import Frame
from stream_dmr.segmentation.annotations.annotated_box import UNKNOWN_ID, AnnotatedBox
from stream_dmr.segmentation.annotations.annotated_fish import AnnotatedFish
from stream_dmr.segmentation.annotations.box_files import load_boxes
from stream_dmr.segmentation.detection.open_detector import DetectFishSettings
from stream_dmr.segmentation.tracking.fish_finder import open_finder
from stream_dmr.segmentation.tracking.tracked_fish import TrackedFish, TrackFishSettings

numbers = st.integers(-200, 2000).map(lambda n: n / 8)
sizes = st.integers(1, 4000).map(lambda n: n / 8)
rows = st.tuples(st.integers(1, 12), st.integers(1, 9), numbers, numbers, sizes, sizes)
tables = st.lists(rows, unique_by=lambda row: row[:2])


def coco(table, *, id_place="track_id") -> str:
    images = [{"id": 100 - f, "file_name": f"clip/{f}.png"} for f in range(1, 13)]
    annotations = []
    for frame, fish, *box in table:
        annotation = {"image_id": 100 - frame, "bbox": box, "category_id": 1}
        if id_place == "attributes":
            annotation["attributes"] = {"track_id": fish}
        elif id_place:
            annotation[id_place] = fish
        annotations.append(annotation)
    return json.dumps({"images": images, "annotations": annotations})


def corners_of(x, y, w, h) -> str:
    return f'xtl="{x}" ytl="{y}" xbr="{x + w}" ybr="{y + h}"'


def cvat_video(table) -> str:
    tracks = ""
    for fish in {row[1] for row in table}:
        boxes = "".join(
            f'<box frame="{f - 1}" outside="0" occluded="0" {corners_of(*box)}/>'
            for f, i, *box in table
            if i == fish
        )
        gone = '<box frame="40" outside="1" xtl="0" ytl="0" xbr="0" ybr="0"/>'
        tracks += f'<track id="{fish - 1}" label="fish">{boxes}{gone}</track>'
    return f"<annotations><version>1.1</version>{tracks}</annotations>"


def contents(frames: dict[int, list[AnnotatedBox]]) -> list[tuple]:
    return [(f, b.track_id, *b.bbox_xyxy_px) for f, boxes in frames.items() for b in boxes]


def mot(table) -> str:
    return "".join(f"{f},{i},{x},{y},{w},{h},1,1,1\n" for f, i, x, y, w, h in table)


@given(tables, st.sampled_from(["track_id", "instance_id", "attributes"]))
def test_the_same_boxes_in_three_formats_are_the_same(tmp_path_factory, table, id_place):
    folder = tmp_path_factory.mktemp("boxes")
    texts = {"a.txt": mot(table), "a.json": coco(table, id_place=id_place)}
    texts["a.xml"] = cvat_video(table)
    read = []
    for name, text in texts.items():
        (folder / name).write_text(text)
        read.append(contents(load_boxes(folder / name)))
    assert read[0] == read[1] == read[2]


def test_pictures_count_in_the_natural_order_of_their_names(tmp_path):
    names = ["10.png", "9.png", "1.png"]
    text = json.dumps(
        {
            "images": [{"id": i, "file_name": name} for i, name in enumerate(names)],
            "annotations": [{"image_id": 0, "bbox": [1, 2, 3, 4], "score": 0.5}],
        }
    )
    (tmp_path / "a.json").write_text(text)
    frames = load_boxes(tmp_path / "a.json")
    assert list(frames) == [3]
    assert (frames[3][0].track_id, frames[3][0].score) == (UNKNOWN_ID, 0.5)


def test_cvat_pictures_have_no_ids(tmp_path):
    box = f"<box label='fish' {corners_of(1, 2, 30, 40)}/>"
    text = f"<annotations><image id='4' name='e.png'>{box}{box}</image></annotations>"
    (tmp_path / "a.xml").write_text(text)
    frames = load_boxes(tmp_path / "a.xml")
    assert [(f, len(boxes), boxes[0].track_id) for f, boxes in frames.items()] == [(5, 2, 0)]


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.json", "{", "expected COCO's JSON"),
        ("a.json", "[]", "expected COCO's JSON"),
        ("a.json", '{"images": [{"id": 1}], "annotations": []}', "file_name"),
        ("a.json", coco([]).replace("[]", '[{"image_id": 9, "bbox": [1,1,1,1]}]'), "annotation 1"),
        ("a.json", coco([(1, 1, 1, 1, 5, 0)]), "annotation 1: expected a width and height above 0"),
        ("a.json", coco([(1, 1, 1, 1, float("nan"), 2)]), "above 0, got nan x 2"),
        ("a.json", coco([(1, 0, 1, 1, 5, 5)]), "annotation 1: expected the image_id"),
        ("a.json", coco([(1, 1, 1, 1, 5, 5), (1, 1, 2, 2, 5, 5)]), "a second one of id 1 in frame"),
        ("a.xml", "<annotations>", "expected CVAT's XML"),
        ("a.xml", "<svg/>", "expected CVAT's <annotations>, got <svg>"),
        ("a.xml", "<annotations><image id='0'><box xtl='1'/></image></annotations>", "image 0"),
        ("a.xml", cvat_video([(1, 1, 5, 5, -2, 5)]), "track 0, frame 0: expected a width"),
    ],
)
def test_files_that_say_nothing_sensible_are_refused(tmp_path, name, text, expected):
    (tmp_path / name).write_text(text)
    with pytest.raises(AnnotationError) as caught:
        load_boxes(tmp_path / name)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def finder(boxes: Path | None, masks: Path | None = None):
    settings = {"detect": DetectFishSettings(), "track": TrackFishSettings(min_track_frames=2)}
    return open_finder(boxes=boxes, masks=masks, **settings)


def test_boxes_with_ids_are_taken_as_they_are_and_others_are_followed(tmp_path):
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
