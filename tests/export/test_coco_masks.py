"""masks.json has the fish of a run as other programs, `train` and `run --boxes` read them."""

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stream_dmr.export.coco_masks import coco_masks, mask_in_frame
from stream_dmr.messages import FishCrop, LocalizedFish
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.recording.codec import compress
from stream_dmr.store.verdicts import Verdict, add_verdict
from stream_dmr.training.annotated_images import read_annotated_images
from tests.support.command import invoke
from tests.support.fish_run import measure, request
from tests.support.reading import read_messages


def by_fish_and_frame(run: Path, kind: type[Any]) -> dict[tuple[int, int], Any]:
    messages = read_messages(run / "recording.mcap", [kind])
    return {(one.track_id, one.frame_index): one for one in messages}  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("IMG_7.jpg", "IMG_7.jpg"),
        ("haul.mp4", "000007.png"),
        ("http://box/picture.jpg", "000007.png"),
    ],
)
def test_pictures_of_a_folder_keep_their_names(source: str, name: str):
    picture = compress(np.zeros((4, 6, 3), np.uint8), format="reference")
    (image,) = coco_masks([(7, source, picture)], [], {}, video="haul")["images"]
    place = {"video_id": 1, "frame_id": 6}
    assert image == {"id": 7, "file_name": name, "width": 6, "height": 4} | place


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fish 1 is a reviewed cod, whose ends were moved in frame 3."""
    out = measure(tmp_path_factory.mktemp("coco"))
    ends = {"head_u": 30.0, "head_v": 22.0, "tail_u": 31.0, "tail_v": 99.0}
    add_verdict(
        out / "lengths.db",
        Verdict(track_id=1, kind="species", species="COD", reviewer="Ada"),
        Verdict(track_id=1, kind="correct", frame_index=3, reviewer="Ada", length_mm=999.0, **ends),
    )
    done = invoke(f"export {out} --masks", {"--out": str(out.parent / "exported")})
    assert done.code == 0, done.err
    return out


def masks_of(run: Path) -> Path:
    return run.parent / "exported" / "masks.json"


def test_train_reads_the_ends_that_were_fitted_or_placed(run: Path, tmp_path: Path):
    fitted = by_fish_and_frame(run, LocalizedFish)
    for frame in range(1, 7):
        cv2.imwrite(str(tmp_path / f"{frame:06d}.png"), np.zeros((120, 160, 3), np.uint8))
    crops = by_fish_and_frame(run, FishCrop)
    for frame, read in enumerate(read_annotated_images(tmp_path, masks_of(run)), start=1):
        fish = sorted(track_id for track_id, index in fitted if index == frame)
        for track_id, mask, ends_px in zip(fish, read.masks, read.ends_px, strict=True):
            expected = fitted[track_id, frame].keypoints_px[[0, 2]]
            if (track_id, frame) == (1, 3):
                expected = [[30, 22], [31, 99]]
            np.testing.assert_allclose(ends_px, expected)
            np.testing.assert_array_equal(mask, mask_in_frame(crops[track_id, frame]))


def test_species_are_categories_and_a_run_is_a_video(run: Path):
    coco = json.loads(masks_of(run).read_text())
    names = {one["id"]: one["name"] for one in coco["categories"]}
    of_fish = {one["instance_id"]: names[one["category_id"]] for one in coco["annotations"]}
    assert of_fish == {1: "COD", 2: "fish"}
    assert all(one["keypoints"] == ["head", "tail"] for one in coco["categories"])
    assert coco["videos"] == [{"id": 1, "name": "video.mp4"}]
    assert [(one["video_id"], one["frame_id"]) for one in coco["images"]] == [
        (1, i) for i in range(6)
    ]


def test_run_takes_boxes_ids_and_masks_back(run: Path):
    again = run.parent / "again"
    options = request(run.parent / "clip", again, boxes=masks_of(run), masks=None)
    measure_source(options, stop=threading.Event())
    first, second = by_fish_and_frame(run, FishCrop), by_fish_and_frame(again, FishCrop)
    assert first.keys() == second.keys()
    for key, crop in first.items():
        np.testing.assert_array_equal(second[key].bbox_xyxy_px, crop.bbox_xyxy_px)
        np.testing.assert_array_equal(mask_in_frame(second[key]), mask_in_frame(crop))


@pytest.mark.parametrize(("reason", "number"), [("low iou", 0), ("no calibration", 2), ("", 2)])
def test_ends_of_refused_frames_are_none(run: Path, reason: str, number: int):
    crop = by_fish_and_frame(run, FishCrop)[2, 3]
    fish = by_fish_and_frame(run, LocalizedFish)[2, 3]
    seen = [(crop, replace(fish, accepted=not reason, reason=reason))]
    (annotation,) = coco_masks([], seen, {}, video="haul")["annotations"]
    assert annotation["num_keypoints"] == number
    assert len(annotation["keypoints"]) == 6
    assert any(annotation["keypoints"]) == (number > 0)


def test_a_mask_is_kept_where_a_crash_came_before_its_place(run: Path):
    crop = by_fish_and_frame(run, FishCrop)[2, 3]
    (annotation,) = coco_masks([], [(crop, None)], {}, video="haul")["annotations"]
    assert annotation["area"] == mask_in_frame(crop).sum() > 0
    assert annotation["num_keypoints"] == 0
