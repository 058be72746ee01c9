"""Examples from a user's images: whole fish, masks that turn along, validation apart."""

import cv2
import numpy as np

from stream_dmr.segmentation.training.annotated_samples import (
    draw_annotated_sample,
    load_fish_cutouts,
)


def test_fish_are_cut_out_whole_and_validation_fish_apart(vessel):
    training, validation = load_fish_cutouts(vessel / "images", vessel / "masks")
    assert (len(training), len(validation)) == (6, 1)
    for cut in (*training, *validation):
        inside = cut[..., 3] > 0
        assert not inside[[0, -1]].any()
        assert cut[..., :3][inside].mean() > 1.8 * cut[..., :3][~inside].mean()


def test_a_rotated_crop_rotates_the_mask(vessel):
    _, [cut] = load_fish_cutouts(vessel / "images", vessel / "masks")
    for seed in range(20):
        sample = draw_annotated_sample(np.random.default_rng(seed), cut)
        bright = cv2.GaussianBlur(sample.image, (0, 0), 2).mean(axis=2)
        inside = sample.mask > 0.5
        assert bright[inside].mean() > bright[~inside].mean() + 20
        assert (inside & (sample.in_box > 0.5)).sum() > 0.8 * inside.sum()
