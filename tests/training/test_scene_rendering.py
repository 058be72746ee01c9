"""What is rendered of a scene: masks of the visible fish, nothing beyond the frame."""

from dataclasses import replace

import numpy as np
import pytest

from stream_dmr.training.image_degradation import PatchBank, make_bank
from stream_dmr.training.random_fish import PATCH_PX
from stream_dmr.training.samples import crop_affine
from stream_dmr.training.surroundings import draw_board
from stream_dmr.training.training_scene import (
    CastShadow,
    TrainingScene,
    cast_shadow,
    draw_scene,
    frame_coverage,
    recolour_backdrop,
    render_scene,
    warp_fish,
)

CROP = crop_affine(np.array([-0.6, -0.6, 0.6, 0.6]), margin=0.0, size=128)


@pytest.fixture(scope="module")
def bank() -> PatchBank:
    return make_bank(num_fish=4, num_backgrounds=2, seed=8, progress=lambda: None)


def scene_of(bank: PatchBank, seed: int) -> TrainingScene:
    """A scene of one fish, with nothing before it."""
    scene = draw_scene(np.random.default_rng(seed), bank)
    frame = np.array([-9.0, -9.0, 9.0, 9.0])
    return replace(scene, ground=[], behind=[], before=[], occluders=[], frame=frame)


def render(bank: PatchBank, scene: TrainingScene) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return render_scene(rng, bank, scene, CROP, targets=[scene.target], size_px=128)


@pytest.mark.parametrize("seed", range(4))
def test_the_mask_of_an_uncovered_fish_is_its_coverage(bank: PatchBank, seed: int):
    scene = scene_of(bank, seed)
    image, mask = render(bank, scene)
    coverage = warp_fish(bank, scene.target, CROP, size=128)[..., 3]
    np.testing.assert_allclose(mask, coverage, atol=1e-6)
    assert image.shape == (128, 128, 3)
    assert mask.sum() > 100


def test_a_fish_before_another_hides_it(bank: PatchBank):
    scene = scene_of(bank, 1)
    _, mask = render(bank, replace(scene, before=[replace(scene.target)]))
    assert mask.max() < 0.26  # of half-covered pixels, half shows


def test_a_shadow_lies_beside_its_fish_and_takes_no_more_light_than_there_is():
    coverage = np.zeros((128, 128), np.float32)
    coverage[40:60, 30:70] = 1
    shadow = CastShadow(offset_px=np.array([10.0, 20.0]), blur_px=2.0, strength=0.7)
    missing = cast_shadow(shadow, coverage)
    assert missing[70, 60] == pytest.approx(0.7, abs=0.01)
    assert 0 <= missing.min() <= missing.max() <= 0.7 + 1e-6
    assert not missing[:50].any()


def test_beyond_the_frame_there_is_nothing(bank: PatchBank):
    scene = replace(scene_of(bank, 2), frame=np.array([-9.0, -9.0, 0.0, 9.0]))
    image, mask = render(bank, scene)
    assert not mask[:, 66:].any()
    assert not image[:, 66:].any()
    assert image[:, :62].any()


def test_the_frame_covers_the_fraction_of_the_crop_that_it_shows():
    half = frame_coverage(np.array([-9.0, -9.0, 0.0, 9.0]), CROP, size=128)
    assert half.mean() == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("seed", range(6))
def test_the_target_fish_is_one_long_and_at_the_origin(bank: PatchBank, seed: int):
    target = draw_scene(np.random.default_rng(seed), bank).target
    corner, opposite = target.to_scene(np.array([[0.0, 0.0], [PATCH_PX - 1.0, PATCH_PX - 1.0]]))
    np.testing.assert_allclose(corner + opposite, 0, atol=1e-9)
    side = target.to_scene(np.array([[0.0, 0.0], [PATCH_PX, 0.0]]))
    assert np.linalg.norm(side[1] - side[0]) == pytest.approx(1)


def test_a_recoloured_backdrop_comes_close_to_a_colour_of_the_fish():
    backdrop = np.random.default_rng(2).uniform(120, 160, (128, 128, 3)).astype(np.float32)
    fish = np.zeros((128, 128, 4), np.float32)
    fish[40:60, 30:70] = (20, 40, 90, 1)
    recoloured = recolour_backdrop(np.random.default_rng(3), backdrop, fish)
    near = np.abs(recoloured.mean(axis=(0, 1)) - [20, 40, 90]).max()
    assert near < 0.6 * np.abs(backdrop.mean(axis=(0, 1)) - [20, 40, 90]).max()
    assert recoloured.std() > 0  # its texture is kept
    assert recolour_backdrop(np.random.default_rng(3), backdrop, 0 * fish) is backdrop


def test_a_board_lies_behind_the_fish(bank: PatchBank):
    scene = replace(scene_of(bank, 3), ground=draw_board(np.random.default_rng(3), 0.0))
    image, mask = render(bank, scene)
    without, mask_without = render(bank, replace(scene, ground=[]))
    np.testing.assert_array_equal(mask, mask_without)
    assert (image != without).any()
