"""Random skins: valid colours, alike on both sides of round fish."""

import numpy as np
import pytest

from stream_dmr.segmentation.training.random_skins import draw_skin_pair


@pytest.mark.parametrize("is_flatfish", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_skins_are_textures_of_valid_colours(seed: int, is_flatfish: bool):
    skins = draw_skin_pair(np.random.default_rng(seed), is_flatfish=is_flatfish)
    assert skins.shape[0] == 2
    assert skins.shape[3] == 3
    assert 0 <= skins.min() < skins.max() <= 255
    assert skins.std() > 1
    assert (skins[0] == skins[1]).all() == (not is_flatfish)
