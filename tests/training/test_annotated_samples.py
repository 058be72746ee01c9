"""Examples from a user's images: whole fish, masks that turn along, validation apart."""

import cv2
import numpy as np
import pytest

from stream_dmr.errors import AnnotationError
from stream_dmr.training.annotated_images import (
    Cutout,
    cutout_patch,
    draw_annotated_sample,
    load_backgrounds,
    load_fish_cutouts,
)
from stream_dmr.training.random_fish import PATCH_PX
from stream_dmr.training.surroundings import BACKGROUND_PX


def test_fish_are_cut_out_whole_and_validation_fish_apart(vessel):
    training, validation = load_fish_cutouts(vessel / "images", vessel / "masks")
    assert (len(training), len(validation)) == (6, 1)
    for cut in (*training, *validation):
        inside = cut.pixels[..., 3] > 0
        assert not inside[[0, -1]].any()
        assert cut.pixels[..., :3][inside].mean() > 1.8 * cut.pixels[..., :3][~inside].mean()


def test_a_rotated_crop_rotates_the_mask(vessel):
    _, [cut] = load_fish_cutouts(vessel / "images", vessel / "masks")
    shares = []
    for seed in range(20):
        sample = draw_annotated_sample(np.random.default_rng(seed), cut, size_px=128)
        bright = cv2.GaussianBlur(sample.image, (0, 0), 2).mean(axis=2)
        inside = sample.mask > 0.5
        assert bright[inside].mean() > bright[~inside].mean() + 20
        shares.append((inside & (sample.in_box > 0.5)).sum() / inside.sum())
    assert np.mean(np.array(shares) > 0.75) > 0.7  # some boxes are around a part


def test_marked_ends_stay_at_the_ends_of_the_mask(vessel):
    """The fish of the fixture are ellipses: their ends are where the mask reaches furthest."""
    _, [cut] = load_fish_cutouts(vessel / "images", vessel / "masks")
    rows, columns = np.nonzero(cut.pixels[..., 3])
    points = np.column_stack([columns, rows])
    _, axes = np.linalg.eigh(np.cov(points.T))
    along = points @ axes[:, 1]
    marked = Cutout(cut.pixels, points[[along.argmin(), along.argmax()]].astype(float))
    patch = cutout_patch(marked)
    columns = np.nonzero(patch.bgra[..., 3] > 127)[1]
    assert sorted(patch.ends_px[:, 0]) == pytest.approx([columns.min(), columns.max()], abs=3)
    for seed in range(10):
        sample = draw_annotated_sample(np.random.default_rng(seed), marked, size_px=128)
        rows, columns = np.nonzero(sample.mask > 0.5)
        inside = ((sample.ends_px > 3) & (sample.ends_px < 124)).all(axis=1)
        for end in sample.ends_px[inside]:
            assert np.hypot(columns - end[0], rows - end[1]).min() < 4
        if inside.all():
            assert np.linalg.norm(np.diff(sample.ends_px, axis=0)) > 0.9 * np.ptp([*columns, *rows])


def test_a_patch_is_the_fish_alone_lying_along_it(vessel):
    training, _ = load_fish_cutouts(vessel / "images", vessel / "masks")
    for cut in training:
        patch = cutout_patch(cut).bgra
        covered = patch[..., 3] > 127
        rows, columns = np.nonzero(covered)
        assert not covered[[0, -1]].any()
        assert not covered[:, [0, -1]].any()
        assert np.ptp(columns) == pytest.approx(PATCH_PX - 8, abs=6)
        assert np.ptp(rows) < 0.7 * np.ptp(columns)
        assert patch[covered][:, :3].mean() > 110  # the fish's colour; around it is dark
        assert not patch[patch[..., 3] == 0].any()


def test_backgrounds_are_the_middle_of_photographs(tmp_path):
    image = np.zeros((100, 300, 3), np.uint8)
    image[:, 110:190] = 200
    cv2.imwrite(str(tmp_path / "deck.png"), image)
    [square] = load_backgrounds(tmp_path)
    assert square.shape == (BACKGROUND_PX, BACKGROUND_PX, 3)
    assert square.mean() == pytest.approx(160, abs=5)


def test_a_folder_without_photographs_is_refused(tmp_path):
    with pytest.raises(AnnotationError, match="expected images"):
        load_backgrounds(tmp_path)
