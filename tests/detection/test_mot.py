"""MOT Challenge text: what is written is read, and what is no such text is refused by line."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.box_files import load_boxes
from stream_dmr.errors import AnnotationError
from tests.support.annotation_files import boxes_file

numbers = st.floats(-1e4, 1e4).map(lambda x: round(x, 3))

sizes = st.floats(0.5, 1e4).map(lambda x: round(x, 3))

rows = st.tuples(
    st.integers(1, 50), st.integers(1, 9), numbers, numbers, sizes, sizes, st.floats(0, 1)
)


def refusal(folder, text):
    with pytest.raises(AnnotationError) as caught:
        load_boxes(boxes_file(folder, text))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@given(st.lists(rows, unique_by=lambda row: row[:2]))
def test_boxes_written_are_boxes_read(tmp_path_factory, table):
    text = "".join(f"{f},{i},{x!r},{y!r},{w!r},{h!r},1,1,{v!r}\n" for f, i, x, y, w, h, v in table)
    boxes = load_boxes(boxes_file(tmp_path_factory.mktemp("boxes"), text))
    read = [
        (frame, box.track_id, *box.bbox_xyxy_px, box.visibility)
        for frame in boxes
        for box in boxes[frame]
    ]
    expected = [(f, i, x, y, x + w, y + h, v) for f, i, x, y, w, h, v in table]
    assert read == sorted(expected)


@pytest.mark.parametrize(
    ("line", "visibility"),
    [
        ("2,3,1,2,30,40,1", 1.0),
        ("2,3,1,2,30,40,1,1", 1.0),
        ("2,3,1,2,30,40,1,1,0.25", 0.25),
        ("2,3,1,2,30,40,1,1,-1", 1.0),
        ("2,3,1,2,30,40,1,-1,-1,-1", 1.0),
        (" 2 , 3.0, 1e0,2,30,40, 1, 1, 0.25 ", 0.25),
    ],
)
def test_optional_columns_may_be_left_out(tmp_path, line, visibility):
    for text in (f"{line}\n", f"\ufeff{line}\r\n\r\n"):
        [box] = load_boxes(boxes_file(tmp_path, text))[2]
        assert (box.track_id, box.visibility) == (3, visibility)
        assert list(box.bbox_xyxy_px) == [1, 2, 31, 42]


@pytest.mark.parametrize(
    "text",
    [
        '{"images": [], "annotations": [{"bbox": [1, 2, 3, 4]}]}',
        "0 0.51 0.42 0.1 0.2",  # YOLO
        "frame,id,x,y,w,h,conf,class,visibility",
        "1 1 10 10 20 20 1 1 1",
        "1;1;10;10;20;20;1;1;1",
        "1,1,10,10,20,20",
        "1,1,10,10,20,20,1,1,1,1,1",
        "1,1,nan,10,20,20,1,1,1",
        "1,1,10,10,inf,20,1,1,1",
        "1,1,10,10,20,,1,1,1",
    ],
)
def test_other_formats_are_refused_by_line(tmp_path, text):
    message = refusal(tmp_path, f"1,7,1,1,5,5,1,1,1\n\n{text}\n")
    assert "line 3: expected numbers frame,id,x,y,w,h,conf,class,visibility" in message
    assert repr(text[:60]) in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1,1,10,10,-20,20,1,1,1", "above 0, got -20 x 20"),
        ("1,1,10,10,20,0,1,1,1", "above 0, got 20 x 0"),
        ("1,-1,10,10,20,20,0.9,-1,-1,-1\n1,2,10,10,20,20,1,1,1", "line 2: expected ids for all"),
        ("1,-2,10,10,20,20,0.9,-1,-1,-1", "or -1 in every line for detections, got -2"),
        ("1,0,10,10,20,20,1,1,1", "an id of 1 or more"),
        ("1,1.5,10,10,20,20,1,1,1", "got 1.5"),
        (f"1,{2**53 + 1},10,10,20,20,1,1,1", "an id up to 9007199254740991"),
        (f"1,{2**63},10,10,20,20,1,1,1", "an id up to 9007199254740991"),
        ("0,1,10,10,20,20,1,1,1", "frame number, counted from 1, got 0"),
        ("1.5,1,10,10,20,20,1,1,1", "frame number, counted from 1, got 1.5"),
        ("1,1,10,10,20,20,1,1,1.2", "visibility from 0 to 1, got 1.2"),
        ("1,1,1,1,2,2,1,1,1\n2,1,1,1,2,2,1\n1,1,3,3,2,2,1", "line 3: expected one box"),
    ],
)
def test_impossible_values_are_refused(tmp_path, text, expected):
    assert expected in refusal(tmp_path, text)
