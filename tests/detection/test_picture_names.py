"""Boxes of COCO and CVAT stand on the pictures that they name, not on those in their place."""

import json
from pathlib import Path

import pytest

from stream_dmr.detection.box_files import frames_by_name, load_boxes
from stream_dmr.errors import AnnotationError

PICTURES = [Path(name) for name in ("IMG_1.jpg", "IMG_2.jpg", "IMG_2.png", "IMG_10.jpg")]
HERE = Path("boxes.json")


def coco_of(folder: Path, names: list[str]) -> Path:
    """A box in each picture, as wide as its number in the file."""
    images = [{"id": i, "file_name": name} for i, name in enumerate(names, start=1)]
    boxes = [{"image_id": i, "bbox": [0, 0, i, 9]} for i in range(1, len(names) + 1)]
    path = folder / "boxes.json"
    path.write_text(json.dumps({"images": images, "annotations": boxes}))
    return path


def widths(path: Path, pictures: Path | None = None) -> dict[int, list[float]]:
    """By frame."""
    boxes = load_boxes(path, pictures=pictures)
    return {frame: [one.bbox_xyxy_px[2] for one in found] for frame, found in boxes.items()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "pictures").mkdir()
    for path in PICTURES:
        (tmp_path / "pictures" / path).touch()
    return tmp_path / "pictures"


def test_a_picture_is_known_by_its_name_else_by_its_stem():
    names = {7: "a/IMG_10.jpg", 8: r"C:\\a\\IMG_1.tif", 9: "IMG_2.png", 5: "other.png"}
    found = frames_by_name(names, PICTURES, where=HERE)
    assert found == {7: 4, 8: 1, 9: 3, 5: 5}
    assert frames_by_name({1: "IMG_2.tif"}, PICTURES, where=HERE) == {}  # of which of them?
    with pytest.raises(AnnotationError, match=r"got a/IMG_1\.jpg and b/IMG_1\.jpg"):
        frames_by_name({1: "a/IMG_1.jpg", 2: "b/IMG_1.jpg"}, PICTURES, where=HERE)


def test_coco_may_leave_pictures_out(folder: Path, tmp_path: Path):
    assert widths(coco_of(tmp_path, ["IMG_10.jpg", "IMG_2.jpg"]), folder) == {4: [1], 2: [2]}
    with pytest.raises(AnnotationError, match=r"named like the 4 pictures .* such as other-1\.jpg"):
        widths(coco_of(tmp_path, ["other-1.jpg"]), folder)
    by_order = coco_of(tmp_path, ["d.jpg", "c.jpg", "b.jpg", "a.jpg"])
    assert widths(by_order, folder) == {1: [4], 2: [3], 3: [2], 4: [1]}


def test_numbers_of_six_digits_are_frames_of_a_video(tmp_path: Path):
    assert widths(coco_of(tmp_path, ["000012.png", "000007.png"])) == {12: [1], 7: [2]}
    assert widths(coco_of(tmp_path, ["12.png", "7.png"])) == {1: [2], 2: [1]}
    assert widths(coco_of(tmp_path, ["000000.png", "000001.png"])) == {1: [1], 2: [2]}


def test_cvat_knows_pictures_by_name_whatever_their_order(folder: Path, tmp_path: Path):
    box = '<box xtl="0" ytl="0" xbr="{}" ybr="9"/>'
    images = "".join(
        f'<image id="{i}" name="{name}">{box.format(i + 1)}</image>'
        for i, name in enumerate(["IMG_1.jpg", "IMG_10.jpg", "IMG_2.jpg"])
    )
    path = tmp_path / "boxes.xml"
    path.write_text(f"<annotations>{images}</annotations>")
    assert widths(path, folder) == {1: [1], 2: [3], 4: [2]}
    assert widths(path) == {1: [1], 2: [2], 3: [3]}
