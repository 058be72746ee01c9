"""Whether a mask has both ends of its fish: the picture that the judge sees, and what it says."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.segmentation.end_judge import HEIGHT_PX, WIDTH_PX, end_picture, missing_end
from stream_dmr.training.random_fish import draw_fish_patch


def spindle(degrees, length_px, size_px=240, slenderness=4):
    """A mask of that length, four times as long as broad, and a picture that is brighter in it."""
    mask = np.zeros((size_px, size_px), np.uint8)
    axes = round(length_px / 2), round(length_px / 2 / slenderness)
    cv2.ellipse(mask, (size_px // 2, size_px // 2), axes, degrees, 0, 360, 1, -1)
    image = np.full((size_px, size_px, 3), 60, np.uint8)
    image[mask > 0] = 180
    return image, mask > 0


@given(st.floats(-90, 90), st.floats(100, 220))
@settings(max_examples=40, deadline=None)
def test_masks_lie_across_the_middle_at_one_size(degrees, length_px):
    seen = end_picture(*spindle(degrees, length_px))
    assert seen.shape == (HEIGHT_PX, WIDTH_PX, 4)
    x, y, width, height = cv2.boundingRect((seen[..., 3] > 127).astype(np.uint8))
    assert (width, height) == (pytest.approx(96, abs=3), pytest.approx(24, abs=3))
    assert x + width / 2 == pytest.approx(WIDTH_PX / 2, abs=2)
    assert y + height / 2 == pytest.approx(HEIGHT_PX / 2, abs=2)
    inside = seen[..., 0] > 120  # the picture is turned and scaled as the mask is
    either = inside | (seen[..., 3] > 127)
    assert np.count_nonzero(inside ^ (seen[..., 3] > 127)) < 0.1 * np.count_nonzero(either)


def drawn(count=24):
    """Drawn fish on a flat ground, with masks that are whole and masks that lack a fifth."""
    fish = []
    for seed in range(count):
        bgra = draw_fish_patch(np.random.default_rng(seed)).bgra.astype(np.float32)
        bgra = np.pad(bgra, [(20, 20), (20, 20), (0, 0)])
        mask = bgra[..., 3] > 127
        image = np.clip(bgra[..., :3] + (255 - bgra[..., 3:]) / 255 * 120, 0, 255)
        points = np.argwhere(mask)
        along = points @ np.linalg.eigh(np.cov(points.T))[1][:, 1]
        cut = np.zeros_like(mask)
        cut[tuple(points[along < along.max() - 0.2 * np.ptp(along)].T)] = True
        fish.append((image.astype(np.uint8), mask, cut))
    return fish


def test_masks_that_lack_an_end_are_told_from_whole_ones():
    found = [[missing_end(image, m) for m in (mask, cut)] for image, mask, cut in drawn()]
    judged = [pair for pair in found if None not in pair]  # the others are too thin
    assert len(judged) > 12
    whole, cut = np.array(judged).T
    assert np.mean(cut[:, None] > whole) > 0.85  # the area under the ROC curve; 0.5 by chance


def test_which_way_a_fish_lies_does_not_matter():
    for image, mask, _ in drawn(4):
        turned = missing_end(np.rot90(image).copy(), np.rot90(mask).copy())
        assert turned == pytest.approx(missing_end(image, mask), abs=0.1)


def test_fish_thinner_than_those_it_learnt_from_are_not_judged():
    found = [missing_end(*spindle(20, 200, slenderness=k)) for k in (6, 7, 10, 14)]
    assert [one is None for one in found] == [False, False, True, True]


def test_nothing_of_a_fish_lacks_an_end():
    image = np.zeros((64, 64, 3), np.uint8)
    assert missing_end(image, np.zeros((64, 64), bool)) == 1.0
