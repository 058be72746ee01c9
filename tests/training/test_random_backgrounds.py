"""Every seed gives a background."""

import numpy as np
import pytest

from stream_dmr.training.surroundings import BACKGROUND_PX, draw_background


@pytest.mark.parametrize("seed", range(20))
def test_every_seed_gives_a_textured_picture(seed):
    picture = draw_background(np.random.default_rng(seed))
    assert picture.shape == (BACKGROUND_PX, BACKGROUND_PX, 3)
    assert picture.std() > 0
