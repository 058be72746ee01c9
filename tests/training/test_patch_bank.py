"""A bank is drawn once and then read from its file; photographs are added to it."""

import numpy as np
import pytest

from stream_dmr.training.image_degradation import PatchBank, load_or_make_bank, make_bank
from stream_dmr.training.random_fish import FishPatch


def test_a_bank_is_drawn_once_and_kept(tmp_path):
    steps = []
    numbers = {"num_fish": 3, "num_backgrounds": 2, "seed": 9}
    first = load_or_make_bank(tmp_path, **numbers, progress=lambda: steps.append(1))
    second = load_or_make_bank(tmp_path, **numbers, progress=lambda: steps.append(1))
    assert len(steps) == 5
    np.testing.assert_array_equal(first.fish, second.fish)
    np.testing.assert_array_equal(first.ends_px, second.ends_px)


@pytest.fixture(scope="module")
def simulated() -> PatchBank:
    return make_bank(num_fish=3, num_backgrounds=2, seed=9, progress=lambda: None)


def test_photographs_are_two_of_five(simulated):
    marks = np.array([[3.0, 80.0], [150.0, 82.0]])
    fish = [FishPatch(bgra=np.full_like(simulated.fish[0], 7), ends_px=marks)]
    backgrounds = [np.full_like(simulated.backgrounds[0], 9)] * 2
    bank = simulated.with_photographs(fish, backgrounds)
    rng = np.random.default_rng(0)
    assert np.mean([bank.draw_fish(rng) == 3 for _ in range(400)]) == pytest.approx(0.4, abs=0.1)
    drawn = [bool((bank.draw_background(rng) == 9).all()) for _ in range(400)]
    assert np.mean(drawn) == pytest.approx(0.4, abs=0.1)
    np.testing.assert_array_equal(bank.ends_px[3], marks)
    assert np.isfinite(bank.ends_px[:3]).all()


def test_without_photographs_every_item_is_drawn_alike(simulated):
    bank = simulated.with_photographs([], [])
    rng = np.random.default_rng(0)
    counts = np.bincount([bank.draw_fish(rng) for _ in range(600)])
    assert counts.min() > 150
