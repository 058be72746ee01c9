"""The samples by which the judge of a mask's ends is trained."""

import numpy as np
import pytest
import torch

from benchmarks.segmentation.end_accuracy import is_whole, paint_over
from benchmarks.segmentation.end_training import EndNet, draw_sample, isolate, missing_beyond
from tests.segmentation.test_end_judge import drawn


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25])
def test_what_lacks_beyond_the_right_end_is_measured_along_the_mask(share):
    truth = np.zeros((60, 240), bool)
    truth[20:40, 20:220] = True
    mask = truth.copy()
    mask[:, round(220 - 200 * share) :] = False
    assert missing_beyond(mask, truth) == pytest.approx(share / (1 - share), abs=0.01)
    assert missing_beyond(truth, mask) == pytest.approx(-share, abs=0.01)


def test_samples_show_a_mask_and_how_much_it_lacks():
    rng = np.random.default_rng(0)
    image, mask, _ = drawn(1)[0]
    fish, grounds = isolate(image, mask), [np.full((300, 400, 3), 90, np.uint8)]
    samples = [draw_sample(rng, fish, grounds) for _ in range(60)]
    missing = np.array([one.missing for one in samples if one is not None])
    assert all(one.seen.shape == (64, 128, 4) for one in samples if one is not None)
    assert (missing > 0.05).mean() > 0.15
    assert (np.abs(missing) < 0.03).mean() > 0.3
    assert (missing < -0.02).any()
    seen = torch.from_numpy(np.stack([one.seen for one in samples[:4]]))
    assert EndNet()(seen).shape == (4, 3)


def test_an_end_that_is_painted_over_is_gone_from_picture_and_box():
    image, mask, _ = drawn(1)[0]
    assert is_whole(mask)
    painted, box = paint_over(np.random.default_rng(1), image, mask, 0.2)
    changed = np.abs(painted.astype(int) - image).max(axis=2) > 25
    lost = np.count_nonzero(changed & mask) / np.count_nonzero(mask)
    assert 0.03 < lost < 0.35
    rows, columns = np.nonzero(mask & ~changed)
    assert box == pytest.approx([columns.min(), rows.min(), columns.max(), rows.max()], abs=15)
