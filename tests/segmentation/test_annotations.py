import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from stream_dmr.errors import AnnotationError, UserError
from stream_dmr.messages import Frame
from stream_dmr.segmentation.annotations.annotated_fish import AnnotatedFish, open_annotated_fish
from stream_dmr.segmentation.annotations.box_files import load_boxes
from stream_dmr.segmentation.annotations.mask_folder import MaskFolder
from stream_dmr.segmentation.masks.grabcut_segmenter import segment_box

SIZE = {"width": 8, "height": 6}
numbers = st.floats(-1e4, 1e4).map(lambda x: round(x, 3))
sizes = st.floats(0.5, 1e4).map(lambda x: round(x, 3))
rows = st.tuples(
    st.integers(1, 50), st.integers(1, 9), numbers, numbers, sizes, sizes, st.floats(0, 1)
)


def boxes_file(folder, text):
    path = folder / "boxes.txt"
    path.write_text(text)
    return path


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
def test_columns_that_may_be_left_out(tmp_path, line, visibility):
    for text in (f"{line}\n", f"\ufeff{line}\r\n\r\n"):
        [box] = load_boxes(boxes_file(tmp_path, text))[2]
        assert (box.track_id, box.visibility) == (3, visibility)
        assert list(box.bbox_xyxy_px) == [1, 2, 31, 42]


def test_an_empty_file_means_no_fish(tmp_path):
    assert load_boxes(boxes_file(tmp_path, "")) == {}
    assert load_boxes(boxes_file(tmp_path, "\n\n")) == {}


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
        ("0,1,10,10,20,20,1,1,1", "frame number, counted from 1, got 0"),
        ("1.5,1,10,10,20,20,1,1,1", "frame number, counted from 1, got 1.5"),
        ("1,1,10,10,20,20,1,1,1.2", "visibility from 0 to 1, got 1.2"),
        ("1,1,1,1,2,2,1,1,1\n2,1,1,1,2,2,1\n1,1,3,3,2,2,1", "line 3: expected one box"),
    ],
)
def test_values_that_cannot_be_are_refused(tmp_path, text, expected):
    assert expected in refusal(tmp_path, text)


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(AnnotationError, match="No such file"):
        load_boxes(tmp_path / "missing.txt")
    with pytest.raises(AnnotationError, match="directory"):
        load_boxes(tmp_path)
    cv2.imwrite(str(tmp_path / "picture.png"), np.full((9, 9), 200, np.uint8))
    with pytest.raises(AnnotationError, match="binary"):
        load_boxes(tmp_path / "picture.png")


def labels_of(**fish):
    """A label picture with one pixel-aligned rectangle per id."""
    labels = np.zeros((SIZE["height"], SIZE["width"]), np.uint8)
    for name, (x0, y0, x1, y1) in fish.items():
        labels[y0:y1, x0:x1] = int(name.removeprefix("id"))
    return labels


def write_palette(path, labels):
    picture = Image.fromarray(labels, mode=None).convert("L")
    palette = Image.frombytes("P", picture.size, picture.tobytes())
    palette.putpalette([value for i in range(256) for value in (255 - i, 7 * i % 256, 3 * i % 256)])
    palette.save(path)


@pytest.mark.parametrize("kind", ["grey", "palette", "16-bit"])
def test_masks_give_ids_whatever_they_are_stored_as(tmp_path, kind):
    labels = labels_of(id1=(0, 0, 2, 2), id3=(4, 1, 7, 5))
    path = tmp_path / "000001.png"
    if kind == "palette":
        write_palette(path, labels)
    else:
        labels = labels.astype(np.uint16) * 100 if kind == "16-bit" else labels
        cv2.imwrite(str(path), labels)
    np.testing.assert_array_equal(MaskFolder(tmp_path).labels(1, **SIZE), labels)


def test_a_1_bit_mask_is_fish_1(tmp_path):
    labels = labels_of(id1=(1, 1, 5, 4))
    Image.fromarray(labels == 1).save(tmp_path / "000001.png")
    np.testing.assert_array_equal(MaskFolder(tmp_path).labels(1, **SIZE), labels)


def test_masks_that_cannot_be_used_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "000001.png"), np.zeros((12, 16), np.uint8))
    cv2.imwrite(str(tmp_path / "000002.png"), np.zeros((6, 8, 3), np.uint8))
    whole = (tmp_path / "000001.png").read_bytes()
    (tmp_path / "000003.png").write_bytes(b"no picture")
    (tmp_path / "000004.png").write_bytes(whole[:-30])
    (tmp_path / "000005.png").touch()
    masks = MaskFolder(tmp_path)
    with pytest.raises(AnnotationError, match=r"000001.*8x6 px, got 16x12 px"):
        masks.labels(1, **SIZE)
    with pytest.raises(AnnotationError, match=r"000002.*colour \(RGB\)"):
        masks.labels(2, **SIZE)
    for frame in (3, 4, 5):
        with pytest.raises(AnnotationError, match=f"00000{frame}.*decoded"):
            masks.labels(frame, width=16, height=12)
    assert masks.labels(6, **SIZE) is None


def test_folders_without_masks_are_refused(tmp_path):
    with pytest.raises(AnnotationError, match="found none there"):
        MaskFolder(tmp_path / "missing")
    with pytest.raises(AnnotationError, match="found no PNG"):
        MaskFolder(tmp_path)
    (tmp_path / "00001.png").touch()
    with pytest.raises(AnnotationError, match=r"found 00001\.png"):
        MaskFolder(tmp_path)
    (tmp_path / "000000.png").touch()
    with pytest.raises(AnnotationError, match=r"counted from 000001\.png"):
        MaskFolder(tmp_path)


def frame_at(index, image=None):
    if image is None:
        image = np.zeros((SIZE["height"], SIZE["width"], 3), np.uint8)
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


def test_a_frame_without_boxes_needs_no_mask(tmp_path):
    cv2.imwrite(str(tmp_path / "000001.png"), labels_of(id1=(0, 0, 2, 2)))
    boxes = boxes_file(tmp_path, "1,1,0,0,3,3,1\n4,1,0,0,3,3,1\n")
    annotations = open_annotated_fish(boxes=boxes, masks=tmp_path)
    for index in (1, 2, 3, 4):
        annotations.detect(frame_at(index))
    assert annotations.warnings == ["masks: no picture for 1 frames, the first of them 4"]


def test_boxes_choose_among_the_masks_and_mismatches_are_told(tmp_path):
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


def test_neither_boxes_nor_masks():
    with pytest.raises(UserError, match="--boxes, --masks or both"):
        open_annotated_fish(boxes=None, masks=None)


def fish_on_sea(*, seed=0, size=(240, 180), axes=(70, 22), angle=30.0, center=(120, 90)):
    """A textured ellipse on textured water, and its true mask."""
    rng = np.random.default_rng(seed)
    truth = np.zeros((size[1], size[0]), np.uint8)
    cv2.ellipse(truth, center, axes, angle, 0, 360, 1, cv2.FILLED)
    sea = np.array([120, 90, 60]) + rng.normal(0, 8, (size[1], size[0], 3))
    fish = np.array([90, 140, 170]) + rng.normal(0, 12, (size[1], size[0], 3))
    image = np.where(truth[..., None] == 1, fish, sea).clip(0, 255).astype(np.uint8)
    return cv2.GaussianBlur(image, (0, 0), 1.0), truth == 1


def box_around(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.min() - 3, rows.min() - 3, columns.max() + 4, rows.max() + 4], float)


def test_boxes_alone_leave_the_mask_to_a_segmenter(tmp_path):
    annotations = AnnotatedFish(
        boxes=load_boxes(boxes_file(tmp_path, "1,1,10,10,50,20,1,1,1")), masks=None
    )
    [detection] = annotations.detect(frame_at(1, np.zeros((90, 120, 3), np.uint8)))
    assert detection.mask is None


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0])
def test_grabcut_finds_a_fish_in_its_box(angle):
    image, truth = fish_on_sea(angle=angle)
    mask = segment_box(image, box_around(truth))
    overlap = (mask & truth).sum() / (mask | truth).sum()
    assert overlap > 0.92  # the blurred rim goes to the fish: a pixel too wide all around
    np.testing.assert_array_equal(segment_box(image, box_around(truth)), mask)


@pytest.mark.parametrize(
    "box",
    [
        (0, 0, 240, 180),  # the whole picture: no sea outside of the box
        (-500, -500, 1500, 1500),
        (100, 80, 101, 81),
        (200.5, 0.25, 700.5, 30.25),
        (239, 179, 289, 229),
    ],
)
@pytest.mark.parametrize("is_flat", [False, True])
def test_grabcut_stands_any_box(box, is_flat):
    image, truth = fish_on_sea()
    image = np.full_like(image, 99) if is_flat else image
    mask = segment_box(image, np.array(box, np.float64))
    assert mask.shape == truth.shape
