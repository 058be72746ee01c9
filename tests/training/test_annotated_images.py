"""A user's masks in every format, and what does not match is refused."""

import json

import cv2
import numpy as np
import pytest

from stream_dmr.errors import AnnotationError
from stream_dmr.training.annotated_images import (
    fade_end,
    load_fish_cutouts,
    read_annotated_images,
)
from tests.support.frames import ellipse_mask


def coco(vessel, segmentations):
    images = [{"id": i, "file_name": f"haul-{i}.png"} for i in range(6)]
    annotations = [
        {"id": i, "image_id": i, "segmentation": one} for i, one in enumerate(segmentations)
    ]
    path = vessel / "coco.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations}))
    return path


def runs_of(mask):
    values = mask.T.ravel()
    edges = np.flatnonzero(np.diff(values)) + 1
    runs = np.diff([0, *edges, values.size]).tolist()
    return [0, *runs] if values[0] else runs


def packed(runs):
    """COCO's way to write run lengths as text; the reader's opposite."""
    text = ""
    for index, run in enumerate(runs):
        value = run - (runs[index - 2] if index > 2 else 0)
        while True:
            bits = value & 31
            value >>= 5
            is_last = value == (-1 if bits & 16 else 0)
            text += chr((bits if is_last else bits | 32) + 48)
            if is_last:
                break
    return text


@pytest.mark.parametrize("kind", ["runs", "packed", "polygon"])
def test_coco_masks_are_the_ones_written(vessel, kind):
    masks = [ellipse_mask(angle=30.0 * index) for index in range(6)]

    def segmentation(mask):
        if kind == "polygon":
            [outline], _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            return [(outline.reshape(-1) + 0.5).tolist()]
        runs = runs_of(mask)
        return {"size": list(mask.shape), "counts": packed(runs) if kind == "packed" else runs}

    file = coco(vessel, [segmentation(mask) for mask in masks])
    for annotated, mask in zip(read_annotated_images(vessel / "images", file), masks, strict=True):
        np.testing.assert_array_equal(annotated.masks[0], mask > 0)


def test_cocos_keypoints_are_head_and_tail(vessel):
    file = coco(vessel, [[[0, 0, 9, 0, 9, 9, 0, 9]]] * 6)
    content = json.loads(file.read_text())
    content["annotations"][1]["keypoints"] = [10, 20, 2, 30.5, 40, 1]
    content["annotations"][2]["keypoints"] = [10, 20, 2, 0, 0, 0]
    content["annotations"][3]["keypoints"] = "elsewhere"
    file.write_text(json.dumps(content))
    ends = [one.ends_px[0] for one in read_annotated_images(vessel / "images", file)]
    np.testing.assert_array_equal(ends[1], [[9.5, 19.5], [30.0, 39.5]])  # pixels, not corners
    np.testing.assert_array_equal(ends[2], [[9.5, 19.5], [np.nan, np.nan]])
    assert np.isnan([ends[0], ends[3], ends[4]]).all()


def test_a_crowd_is_no_fish(vessel):
    square = [[0, 0, 9, 0, 9, 9, 0, 9]]
    file = coco(vessel, [square] * 6)
    content = json.loads(file.read_text())
    content["annotations"][2]["iscrowd"] = 1
    file.write_text(json.dumps(content))
    names = [one.path.name for one in read_annotated_images(vessel / "images", file)]
    assert names == [f"haul-{i}.png" for i in (0, 1, 3, 4, 5)]


@pytest.mark.parametrize("has_ids", [True, False])
def test_what_is_unknown_beside_ids_is_no_fish(vessel, has_ids):
    for path in (vessel / "masks").iterdir():
        mask = ellipse_mask()
        labels = np.where(mask > 0, 1 if has_ids and path.stem != "haul-0" else 255, 0)
        labels[:5, :5] = 255
        cv2.imwrite(str(path), labels.astype(np.uint8))
    found = [len(one.masks) for one in read_annotated_images(vessel / "images", vessel / "masks")]
    assert found == ([0, 1, 1, 1, 1, 1] if has_ids else [1] * 6)


@pytest.mark.parametrize("seed", range(6))
def test_a_fading_end_goes_over_into_the_ground_and_the_rest_stays(seed):
    mask = ellipse_mask(size=(128, 128), center=(64, 64), axes=(50, 15), angle=0.0) > 0
    picture = np.where(mask[..., None], 200.0, 40.0).astype(np.float32).repeat(3, axis=2)[..., :3]
    faded = fade_end(np.random.default_rng(seed), picture, mask)
    np.testing.assert_allclose(faded[~mask], 40.0, atol=8)  # but for the rim
    light = [faded[64, column].mean() for column in (16, 64, 112)]
    assert light[1] == pytest.approx(200, abs=8)  # the middle keeps its own
    assert sorted([light[0], light[2]])[0] < 170  # one end fades
    assert max(light[0], light[2]) == pytest.approx(200, abs=8)


def refusal(images, masks):
    with pytest.raises(AnnotationError) as caught:
        load_fish_cutouts(images, masks)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_images_and_masks_that_do_not_match_are_refused(vessel):
    images, masks = vessel / "images", vessel / "masks"
    assert "found none there" in refusal(vessel / "nowhere", masks)
    (vessel / "empty").mkdir()
    assert "expected images" in refusal(vessel / "empty", masks)
    assert "a folder of their own" in refusal(images, images)
    assert "a folder of PNG masks or a COCO .json" in refusal(images, vessel / "masks.txt")
    cv2.imwrite(str(masks / "haul-3.png"), np.zeros((10, 20), np.uint8))
    assert "160x120 px, got 20x10 px" in refusal(images, masks)
    cv2.imwrite(str(masks / "haul-3.png"), np.zeros((120, 160, 3), np.uint8))
    assert "one channel" in refusal(images, masks)
    (masks / "haul-3.png").unlink()
    assert "none for 1, the first of them haul-3.png" in refusal(images, masks)
    for path in masks.iterdir():
        cv2.imwrite(str(path), np.zeros((120, 160), np.uint8))
    cv2.imwrite(str(masks / "haul-3.png"), np.zeros((120, 160), np.uint8))
    assert "0 fish to train on" in refusal(images, masks)


def test_coco_files_of_another_kind_are_refused(vessel):
    images, file = vessel / "images", vessel / "coco.json"
    assert "expected a COCO .json" in refusal(images, file)
    for text in ("{", "[]", '{"images": []}', '{"images": [{"id": 1}], "annotations": []}'):
        file.write_text(text)
        assert "COCO's JSON" in refusal(images, file)
    coco(vessel, [{"size": [9, 9], "counts": [81]}])
    assert "annotation 0: expected a mask of" in refusal(images, file)
    coco(vessel, ["nonsense"])
    assert "polygons or run lengths" in refusal(images, file)
    (images / "haul-0.png").unlink()
    assert "expected haul-0.png among the images" in refusal(images, file)


def _change_images(path, change):
    table = json.loads(path.read_text())
    change(table["images"])
    path.write_text(json.dumps(table))


def test_polygons_of_pictures_of_another_size_are_refused(tmp_path):
    file = _square(tmp_path, {"width": 128, "height": 96})
    assert "of 64x48 px" in refusal(tmp_path / "images", file)


def test_images_of_one_name_or_id_are_refused(tmp_path):
    for second in ({"id": 2, "file_name": "other/a.png"}, {"id": 1, "file_name": "b.png"}):
        assert "of its own" in refusal(tmp_path / "images", _square(tmp_path, {}, second))


def _square(folder, said, *more):
    (folder / "images").mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "images" / "a.png"), np.zeros((48, 64, 3), np.uint8))
    cv2.imwrite(str(folder / "images" / "b.png"), np.zeros((48, 64, 3), np.uint8))
    square = {"id": 1, "image_id": 1, "segmentation": [[10, 10, 30, 10, 30, 20, 10, 20]]}
    images = [{"id": 1, "file_name": "a.png"} | said, *more]
    (folder / "masks.json").write_text(json.dumps({"images": images, "annotations": [square]}))
    return folder / "masks.json"
