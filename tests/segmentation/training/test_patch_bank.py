"""A bank is drawn once and then read from its file."""

import numpy as np

from stream_dmr.segmentation.training.patch_bank import load_or_make_bank


def test_a_bank_is_drawn_once_and_kept(tmp_path):
    steps = []
    numbers = {"num_fish": 3, "num_backgrounds": 2, "seed": 9}
    first = load_or_make_bank(tmp_path, **numbers, progress=lambda: steps.append(1))
    second = load_or_make_bank(tmp_path, **numbers, progress=lambda: steps.append(1))
    assert len(steps) == 5
    np.testing.assert_array_equal(first.fish, second.fish)
    np.testing.assert_array_equal(first.ends_px, second.ends_px)
