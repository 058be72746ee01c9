"""Random skins: valid colours, alike on both sides of round fish."""

import numpy as np
import pytest

from stream_dmr.training import random_fish
from stream_dmr.training.random_fish import draw_skin_pair


@pytest.mark.parametrize("is_flatfish", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_skins_are_textures_of_valid_colours(seed: int, is_flatfish: bool):
    skins = draw_skin_pair(np.random.default_rng(seed), is_flatfish=is_flatfish)
    assert skins.shape[0] == 2
    assert skins.shape[3] == 3
    assert 0 <= skins.min() < skins.max() <= 255
    assert skins.std() > 1
    assert (skins[0] == skins[1]).all() == (not is_flatfish)


def test_two_coloured_skins_differ_more_along_the_fish(monkeypatch: pytest.MonkeyPatch):
    def difference(share: float) -> float:
        monkeypatch.setattr(random_fish, "_TWO_COLOURS_SHARE", share)
        skins = [draw_skin_pair(np.random.default_rng(i), is_flatfish=False)[0] for i in range(30)]
        return float(np.median([np.abs(np.ptp(s.mean(axis=1), axis=0)).max() for s in skins]))

    assert difference(1.0) > 1.2 * difference(0.0)
