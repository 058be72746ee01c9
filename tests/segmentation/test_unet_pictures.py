import json

import cv2
import numpy as np
import pytest

from stream_dmr.errors import AnnotationError
from stream_dmr.segmentation.training.annotated_images import read_annotated_images
from stream_dmr.segmentation.training.annotated_samples import (
    draw_annotated_sample,
    load_fish_cutouts,
)
from stream_dmr.segmentation.training.draw_sample import draw_sample
from stream_dmr.segmentation.training.fish_patches import PATCH_PX, draw_fish_patch
from stream_dmr.segmentation.training.patch_bank import PatchBank, load_or_make_bank, make_bank
from stream_dmr.segmentation.training.random_backgrounds import BACKGROUND_PX, draw_background
from stream_dmr.segmentation.training.training_sample import TrainingSample


@pytest.fixture(scope="module")
def bank() -> PatchBank:
    return make_bank(num_fish=12, num_backgrounds=4, seed=5, progress=lambda: None)


def assert_equal(one: TrainingSample, other: TrainingSample):
    for name in ("image", "mask", "in_box", "ends_px"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("seed", range(6))
def test_a_fish_fills_its_patch_from_head_to_tail(seed):
    patch = draw_fish_patch(np.random.default_rng(seed))
    alpha = patch.bgra[..., 3]
    _, _, width, height = cv2.boundingRect((alpha > 127).astype(np.uint8))
    assert PATCH_PX - 12 <= max(width, height) <= PATCH_PX - 6
    assert not alpha[[0, -1]].any()
    assert (patch.bgra[..., :3].max(axis=2) <= alpha.astype(int) + 1).all()  # colour times coverage
    near = cv2.dilate(alpha, np.ones((9, 9)))
    for column, row in np.round(patch.ends_px).astype(int):
        assert near[row, column] > 0


@pytest.mark.parametrize("seed", range(20))
def test_any_background_is_a_picture(seed):
    picture = draw_background(np.random.default_rng(seed))
    assert picture.shape == (BACKGROUND_PX, BACKGROUND_PX, 3)
    assert picture.std() > 0


def test_equal_seeds_give_equal_pictures(bank):
    for seed in range(8):
        one, other = (draw_sample(np.random.default_rng(seed), bank) for _ in range(2))
        assert_equal(one, other)
    again = make_bank(num_fish=12, num_backgrounds=4, seed=5, progress=lambda: None)
    np.testing.assert_array_equal(again.fish, bank.fish)


def test_boxes_fit_the_fish_that_they_mean(bank):
    shares, extents = [], []
    for seed in range(150):
        sample = draw_sample(np.random.default_rng((1, seed)), bank)
        assert 0 <= sample.mask.min() <= sample.mask.max() <= 1 + 1e-6
        if sample.in_box.min() == 1 or sample.mask.sum() < 50:
            continue  # no box is given, or next to nothing is seen
        fish, box = sample.mask > 0.5, sample.in_box > 0.5
        shares.append((fish & box).sum() / fish.sum())
        inner, outer = (cv2.boundingRect(part.astype(np.uint8))[2:] for part in (fish & box, box))
        extents.append(max(a / b for a, b in zip(inner, outer, strict=True)))
    assert np.median(shares) > 0.98
    assert np.median(extents) > 0.94
    assert len(shares) > 100


def test_heads_and_tails_lie_at_the_ends_of_their_fish(bank):
    distances = []
    for seed in range(80):
        sample = draw_sample(np.random.default_rng((2, seed)), bank)
        if sample.ends_px is None:
            assert sample.in_box.min() == 1 or not sample.mask.any()  # no box, or no fish in it
            continue
        rows, columns = np.nonzero(sample.mask > 0.5)
        fish = np.column_stack([columns, rows])
        inside = ((sample.ends_px > 2) & (sample.ends_px < 125)).all(axis=1)
        for end in sample.ends_px[inside]:
            distances.append(np.linalg.norm(fish - end, axis=1).min())
    assert np.quantile(distances, 0.7) < 3.0  # others are hidden


def test_a_bank_is_drawn_once_and_kept(tmp_path):
    steps = []
    numbers = {"num_fish": 3, "num_backgrounds": 2, "seed": 9}
    first = load_or_make_bank(tmp_path, **numbers, progress=lambda: steps.append(1))
    second = load_or_make_bank(tmp_path, **numbers, progress=lambda: steps.append(1))
    assert len(steps) == 5
    np.testing.assert_array_equal(first.fish, second.fish)
    np.testing.assert_array_equal(first.ends_px, second.ends_px)


def ellipse(size=(120, 160), center=(80, 60), axes=(50, 14), angle=20.0):
    mask = np.zeros(size, np.uint8)
    cv2.ellipse(mask, center, axes, angle, 0, 360, 1, -1)
    return mask


@pytest.fixture
def vessel(tmp_path):
    """Six images with one or two fish each, and their masks."""
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    rng = np.random.default_rng(0)
    for index in range(6):
        labels = ellipse(angle=30.0 * index)
        if index == 0:
            labels += 2 * ellipse(center=(20, 20), axes=(15, 6))
        image = rng.integers(0, 60, (*labels.shape, 3), np.uint8)
        image[labels > 0] += 120
        cv2.imwrite(str(tmp_path / "images" / f"haul-{index}.png"), image)
        cv2.imwrite(str(tmp_path / "masks" / f"haul-{index}.png"), labels)
    return tmp_path


def test_own_fish_are_cut_out_whole_and_checked_apart(vessel):
    training, validation = load_fish_cutouts(vessel / "images", vessel / "masks")
    assert (len(training), len(validation)) == (6, 1)
    for cut in (*training, *validation):
        inside = cut[..., 3] > 0
        assert not inside[[0, -1]].any()
        assert cut[..., :3][inside].mean() > 1.8 * cut[..., :3][~inside].mean()


def test_a_turned_crop_turns_the_mask_along(vessel):
    _, [cut] = load_fish_cutouts(vessel / "images", vessel / "masks")
    for seed in range(20):
        sample = draw_annotated_sample(np.random.default_rng(seed), cut)
        bright = cv2.GaussianBlur(sample.image, (0, 0), 2).mean(axis=2)
        inside = sample.mask > 0.5
        assert bright[inside].mean() > bright[~inside].mean() + 20
        assert (inside & (sample.in_box > 0.5)).sum() > 0.8 * inside.sum()


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
    masks = [ellipse(angle=30.0 * index) for index in range(6)]

    def segmentation(mask):
        if kind == "polygon":
            [outline], _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            return [(outline.reshape(-1) + 0.5).tolist()]
        runs = runs_of(mask)
        return {"size": list(mask.shape), "counts": packed(runs) if kind == "packed" else runs}

    file = coco(vessel, [segmentation(mask) for mask in masks])
    for annotated, mask in zip(read_annotated_images(vessel / "images", file), masks, strict=True):
        np.testing.assert_array_equal(annotated.masks[0], mask > 0)


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


def test_coco_files_that_are_none_are_refused(vessel):
    images, file = vessel / "images", vessel / "coco.json"
    assert "expected a COCO .json" in refusal(images, file)
    for text in ("{", "[]", '{"images": []}', '{"images": [{"id": 1}], "annotations": []}'):
        file.write_text(text)
        assert "COCO's JSON" in refusal(images, file)
    coco(vessel, [{"size": [9, 9], "counts": [81]}])
    assert "another size (annotation 0)" in refusal(images, file)
    coco(vessel, ["nonsense"])
    assert "polygons or run lengths" in refusal(images, file)
    (images / "haul-0.png").unlink()
    assert "expected haul-0.png among the images" in refusal(images, file)
