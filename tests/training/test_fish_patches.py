"""A simulated fish fills its patch."""

import cv2
import numpy as np
import pytest

from stream_dmr.training.random_fish import PATCH_PX, draw_fish_patch


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
