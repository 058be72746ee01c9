"""Fish by boxes, masks or both, and the mismatches between them."""

from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.box_files import load_boxes
from stream_dmr.detection.given_fish import AnnotatedFish, open_annotated_fish
from stream_dmr.detection.mask_folder import MaskFolder
from stream_dmr.errors import AnnotationError
from stream_dmr.messages import Frame
from tests.support.annotation_files import LABELS_SIZE, boxes_file, labels_of


def frame_at(index, image=None):
    if image is None:
        image = np.zeros((LABELS_SIZE["height"], LABELS_SIZE["width"], 3), np.uint8)
    return Frame(frame_index=index, timestamp_ns=index, image=image, source="test")


def test_masks_alone_give_the_boxes(tmp_path):
    cv2.imwrite(str(tmp_path / "000001.png"), labels_of(id3=(4, 1, 7, 5), id1=(0, 0, 2, 2)))
    annotations = open_annotated_fish(boxes=None, masks=tmp_path)
    first, second = annotations.detect(frame_at(1))
    assert (first.source_id, second.source_id) == (1, 3)
    assert list(second.bbox_xyxy_px) == [4, 1, 7, 5]
    assert second.visible_fraction == 1.0
    assert second.mask.sum() == 12
    assert annotations.warnings == []
    assert annotations.detect(frame_at(2)) == annotations.detect(frame_at(3)) == []
    assert annotations.warnings == ["masks: no picture for 2 frames, the first of them 2"]


def test_equal_ids_of_stills_are_said_to_be_one_fish(tmp_path):
    for number in (1, 2):
        labels = labels_of(id1=(0, 0, 2, 2)) + number * labels_of(id1=(4, 1, 7, 5))
        cv2.imwrite(str(tmp_path / f"00000{number}.png"), 2 * labels)
    for across_frames in (True, False):
        annotations = open_annotated_fish(boxes=None, masks=tmp_path, across_frames=across_frames)
        for _ in range(2):  # once to learn shapes, once to measure
            for index in (1, 2):
                annotations.detect(frame_at(index))
        said = [line.partition("; ")[0] for line in annotations.warnings]
        expected = "--stills: equal ids were taken for one fish with one length: id 2 in 2 pictures"
        assert said == ([] if across_frames else [expected])


def test_a_frame_without_boxes_needs_no_mask(tmp_path):
    cv2.imwrite(str(tmp_path / "000001.png"), labels_of(id1=(0, 0, 2, 2)))
    boxes = boxes_file(tmp_path, "1,1,0,0,3,3,1\n4,1,0,0,3,3,1\n")
    annotations = open_annotated_fish(boxes=boxes, masks=tmp_path)
    for index in (1, 2, 3, 4):
        annotations.detect(frame_at(index))
    assert annotations.warnings == ["masks: no picture for 1 frames, the first of them 4"]


@given(last=st.integers(1, 12), frames=st.sets(st.integers(1, 12), min_size=1))
def test_masks_are_unused_where_no_frame_is(last: int, frames: set[int]):
    with TemporaryDirectory() as folder:
        for index in frames:
            (Path(folder) / f"{index:06d}.png").touch()
        said = MaskFolder(Path(folder)).unused(last)
    beyond = [index for index in frames if index > last]
    assert bool(said) == bool(beyond)
    if beyond:
        which = "all" if len(beyond) == len(frames) else "some"
        assert f"{which} are past" in said[0]
        assert f"{len(beyond)} pictures from {min(beyond)} on" in said[0]


def test_boxes_select_masks_and_mismatches_are_reported(tmp_path):
    cv2.imwrite(str(tmp_path / "000001.png"), labels_of(id3=(4, 1, 7, 5), id1=(0, 0, 2, 2)))
    boxes = boxes_file(
        tmp_path,
        "1,1,0,0,3,3,1,1,0.5\n1,2,3,3,2,2,1,1,1\n2,1,0,0,3,3,1\n2,9,-20,0,10,10,1\n",
    )
    annotations = open_annotated_fish(boxes=boxes, masks=tmp_path)
    first, second = annotations.detect(frame_at(1))
    assert (first.source_id, first.visible_fraction, first.mask.sum()) == (1, 0.5, 4)
    assert (second.source_id, second.mask.any()) == (2, False)
    [kept] = annotations.detect(frame_at(2))
    assert not kept.mask.any()
    assert annotations.warnings == [
        "masks: no picture for 1 frames, the first of them 2",
        "boxes: 1 lie outside the picture and were left out, the first of them of id 9 in frame 2",
        "boxes: ids 2 are in no mask, so have no outline",
        "masks: ids 3 have no box, so were left out",
    ]


def test_boxes_without_ids_beside_masks_are_refused(tmp_path):
    boxes = boxes_file(tmp_path, "1,-1,0,0,3,3,1\n")
    with pytest.raises(AnnotationError, match="expected the ids of --masks"):
        open_annotated_fish(boxes=boxes, masks=tmp_path)


def test_boxes_alone_leave_the_mask_to_a_segmenter(tmp_path):
    annotations = AnnotatedFish(
        boxes=load_boxes(boxes_file(tmp_path, "1,1,10,10,50,20,1,1,1")), masks=None
    )
    [detection] = annotations.detect(frame_at(1, np.zeros((90, 120, 3), np.uint8)))
    assert detection.mask is None
