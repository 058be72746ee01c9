"""Shapes learnt from crops: of whole fish only, and what they are said to be."""

from dataclasses import replace

import numpy as np
import pytest

from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.space import TRUNK
from stream_dmr.fitting.shape.stocks import learn_shapes
from tests.support.stocks import TEMPLATE, broader, fish_of, forms

SETTINGS = FitMeshSettings(max_faces=600, contour_iterations=8)


def learnt(crops, progress=lambda step: None):
    return learn_shapes(crops, TEMPLATE, forms(), SETTINGS, calibration=None, progress=progress)


def test_without_fish_nothing_is_learnt():
    assert learnt([]) is None


def test_fish_that_are_cut_off_teach_nothing():
    (sample,) = fish_of(broader(0.0), track_id=1, num_frames=1).samples
    mask = sample.crop.mask.copy()
    mask[:] = False
    mask[:3, :3] = True  # a corner: no fish of any form fits it
    assert learnt([replace(sample.crop, mask=mask)]) is None


def test_broad_fish_give_a_broad_stock_and_say_how_far_they_are():
    crops = [
        sample.crop
        for k in (1, 2)
        for sample in fish_of(broader(0.4), track_id=k, num_frames=1).samples
    ]
    steps = list[str]()
    stocks = learnt(crops, steps.append)
    assert stocks is not None
    assert stocks.are_learnt
    assert len(stocks) == 1
    assert TRUNK @ stocks.coefficients[0] == pytest.approx(0.4, abs=0.12)
    assert np.isclose(stocks.shares.sum(), 1.0)
    assert any("2 fish" in step for step in steps)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.cpu_count", lambda: 1)
        on_one_core = learnt(crops)
    assert on_one_core is not None
    np.testing.assert_array_equal(on_one_core.coefficients, stocks.coefficients)
