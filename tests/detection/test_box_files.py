"""A boxes file means the same in each of its four formats."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.box_files import AnnotatedBox, load_boxes
from stream_dmr.errors import AnnotationError
from tests.support.annotation_files import boxes_file, coco, cvat_video, mot, viame

numbers = st.integers(-200, 2000).map(lambda n: n / 8)

sizes = st.integers(1, 4000).map(lambda n: n / 8)

rows = st.tuples(st.integers(1, 12), st.integers(1, 9), numbers, numbers, sizes, sizes)

tables = st.lists(rows, unique_by=lambda row: row[:2])


def contents(frames: dict[int, list[AnnotatedBox]]) -> list[tuple]:
    return [(f, b.track_id, *b.bbox_xyxy_px) for f, boxes in frames.items() for b in boxes]


@given(tables, st.sampled_from(["track_id", "instance_id", "attributes"]))
def test_the_same_boxes_in_four_formats_are_the_same(tmp_path_factory, table, id_place):
    folder = tmp_path_factory.mktemp("boxes")
    texts = {"a.txt": mot(table), "a.json": coco(table, id_place=id_place)}
    texts |= {"a.xml": cvat_video(table), "a.csv": viame(table)}
    read = []
    for name, text in texts.items():
        (folder / name).write_text(text)
        read.append(contents(load_boxes(folder / name)))
    assert read[0] == read[1] == read[2] == read[3]


def test_an_empty_file_means_no_fish(tmp_path):
    assert load_boxes(boxes_file(tmp_path, "")) == {}
    assert load_boxes(boxes_file(tmp_path, "\n\n")) == {}


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(AnnotationError, match="No such file"):
        load_boxes(tmp_path / "missing.txt")
    with pytest.raises(AnnotationError, match="folder of YOLO labels alone"):
        load_boxes(tmp_path)
    cv2.imwrite(str(tmp_path / "picture.png"), np.full((9, 9), 200, np.uint8))
    with pytest.raises(AnnotationError, match="binary"):
        load_boxes(tmp_path / "picture.png")
