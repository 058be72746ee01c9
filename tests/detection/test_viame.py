"""Tracks, boxes and polygons of VIAME CSV."""

from pathlib import Path

import numpy as np
import pytest

from stream_dmr.detection.box_files import parse_viame
from stream_dmr.detection.given_fish import AnnotatedFish
from stream_dmr.errors import AnnotationError
from stream_dmr.messages import Frame

PATH = Path("x.viame.csv")  # for messages
SQUARE = "(poly) 1 1 7 1 7 7 1 7"


def row(track: int, frame: int, *cells: str, name: str = "", box: str = "1,1,7,7") -> str:
    return ",".join([str(track), name, str(frame), box, "0.5", "-1", "fish", "1.0", *cells]) + "\n"


def test_polygons_are_masks_and_other_boxes_are_left_to_the_segmenter():
    drawn = row(3, 0, SQUARE, "(hole) 3 3 5 3 5 5 3 5", "(poly) 8 8 9 8 9 9 8 9")
    frames = parse_viame(drawn + row(4, 0, "(kp) head 1 2"), PATH)
    frame = Frame(frame_index=1, timestamp_ns=0, image=np.zeros((10, 12, 3), np.uint8), source="")
    fish = AnnotatedFish(boxes=frames, masks=None)
    first, second = fish.detect(frame)
    expected = np.zeros((10, 12), bool)
    expected[1:7, 1:7] = expected[8, 8] = True
    expected[3:5, 3:5] = False
    np.testing.assert_array_equal(first.mask, expected)
    assert second.mask is None
    assert not fish.has_masks
    assert AnnotatedFish(boxes=parse_viame(drawn, PATH), masks=None).has_masks


def test_tracks_keep_their_ids_and_track_0_gets_a_free_one():
    frames = parse_viame(row(0, 0) + row(7, 0) + row(2, 4) + row(0, 4), PATH)
    ids = {frame: [box.track_id for box in boxes] for frame, boxes in frames.items()}
    assert ids == {1: [7, 8], 5: [2, 8]}


def test_pictures_of_a_folder_are_known_by_their_names():
    text = row(1, 0, name="b.jpg") + row(2, 0, name="b.jpg") + row(1, 1, name="c.jpg")
    pictures = [Path(name) for name in ("a.jpg", "b.jpg", "c.jpg")]
    assert list(parse_viame(text, PATH, pictures)) == [2, 3]
    assert list(parse_viame(text, PATH)) == [1, 2]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (row(1, 0) + "1,a,0,1,1\n", "line 2: expected VIAME's track"),
        (row(-1, 0), "line 1: expected VIAME's track"),
        (row(1, -1), "line 1: expected VIAME's track"),
        (row(1, 0, "(poly) 1 1 2 2"), "polygons of three points"),
        (row(1, 0, "(poly) 1 1 2 2 3"), "polygons of three points"),
        (row(1, 0, "(poly) 1 1 2 2 nan 3"), "polygons of three points"),
        (row(1, 0, "(poly) 1 1 2 2 1e308 3"), "within 1e+06 px, got one at 1e+308 px"),
        (row(1, 0, "(hole) 1 1 2 2 3 3"), "polygons of three points"),
        (row(1, 0, box="5,5,5,9"), "line 1: expected a width and height above 0"),
        (row(1, 0) + row(1, 0), "line 2: expected one box per fish and frame"),
        (row(1, 0, "(poly)" + " 12" * 50_000), "line 1: expected a row of VIAME CSV"),
    ],
)
def test_rows_that_are_none_are_refused(text: str, expected: str):
    with pytest.raises(AnnotationError) as caught:
        parse_viame(text, PATH)
    assert expected in str(caught.value)
