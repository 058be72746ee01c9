"""The background model: what it learns, and which colours it finds foreign."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.detection.background_model import BackgroundModel, wide_median

HEIGHT, WIDTH = 96, 128
EVERYWHERE = np.ones((HEIGHT, WIDTH), np.float32)
seeds = st.integers(0, 99)


def picture_of(planes: np.ndarray) -> np.ndarray:
    return planes.round().clip(0, 255).astype(np.uint8)


def noise(seed: int, *, level: float = 120.0, std: float = 6.0) -> np.ndarray:
    """A calm picture with noise of this standard deviation in each channel."""
    rng = np.random.default_rng(seed)
    return picture_of(level + std * rng.standard_normal((3, HEIGHT, WIDTH)))


def waves(seed: int) -> np.ndarray:
    """A picture that varies along one line of colours, dark green to white."""
    heights = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH))
    line = np.array([20.0, 16.0, 8.0])[:, None, None]
    return picture_of(100 + heights * line)


def learnt(pictures: list[np.ndarray], *, memory_frames: float = 1e6) -> BackgroundModel:
    model = BackgroundModel(pictures[0], memory_frames=memory_frames)
    for picture in pictures[1:]:
        model.learn(picture, model.distance(picture), EVERYWHERE)
    return model


@settings(max_examples=10)
@given(seeds)
def test_the_distance_of_the_background_averages_the_number_of_channels(seed: int):
    model = learnt([noise(10 * seed + i) for i in range(10)])
    distance = model.distance(noise(10 * seed + 99))
    assert (distance >= 0).all()
    assert distance.mean() == pytest.approx(3, rel=0.35)


@settings(max_examples=5)
@given(seeds)
def test_the_distance_is_by_the_inverse_covariance_of_regions_enlarged_to_the_picture(seed: int):
    model = BackgroundModel(picture_of(np.full((3, HEIGHT, WIDTH), 120.0)), memory_frames=1e6)
    seen, picture = noise(2 * seed, std=4), noise(2 * seed + 1, std=4)
    before = model.distance(seen)
    model.learn(seen, before, EVERYWHERE)

    weight = 1.0 * (before < 9)[::3, ::3]
    change = seen[:, ::3, ::3] - 120.0
    light = np.array([region_means(plane, weight) for plane in change])
    rest = change - light
    covariance = 4.0 * np.eye(3) + np.zeros((*weight.shape, 3, 3))
    for i, j in np.ndindex(3, 3):
        covariance[..., i, j] += 0.11 * region_means(rest[i] * rest[j], weight)
    inverse = enlarged(np.linalg.inv(covariance).reshape(*weight.shape, 9))
    inverse = inverse.reshape(HEIGHT, WIDTH, 3, 3)
    off = picture.transpose(1, 2, 0) - model.mean.transpose(1, 2, 0)
    off -= enlarged(light.transpose(1, 2, 0))
    variance_ratio = (1 + (before / 3).clip(1, 8)) / 2
    expected = np.einsum("hwi,hwij,hwj->hw", off, inverse, off) / variance_ratio
    np.testing.assert_allclose(model.distance(picture), expected, rtol=1e-3, atol=1e-3)


def region_means(layer: np.ndarray, weight: np.ndarray) -> np.ndarray:
    sums, total = (
        cv2.blur(part, (5, 5), borderType=cv2.BORDER_REFLECT) for part in (weight * layer, weight)
    )
    return sums / (total + 1e-3)


def enlarged(layers: np.ndarray) -> np.ndarray:
    return cv2.resize(layers, (WIDTH, HEIGHT))


@settings(max_examples=10)
@given(seeds)
def test_the_mean_is_that_of_the_pictures_seen(seed: int):
    pictures = [noise(5 * seed + i) for i in range(5)]
    is_known = (learnt(pictures[:1]).mean == pictures[0]).all(axis=0)  # others begin as foreign
    assert is_known.mean() > 0.97
    mean, expected = learnt(pictures).mean, np.mean(pictures, axis=0)
    np.testing.assert_allclose(mean[:, is_known], expected[:, is_known], atol=1e-2)


def test_a_short_memory_forgets_exponentially():
    model = learnt([noise(i) for i in range(5)], memory_frames=2.0)
    before, picture = model.mean.copy(), noise(9)
    model.learn(picture, model.distance(picture), EVERYWHERE)
    np.testing.assert_allclose(model.mean, (before + picture) / 2, atol=1e-3)


def test_nothing_is_learnt_at_rate_zero():
    model = learnt([noise(0), noise(1)])
    before = model.mean.copy()
    model.learn(noise(2), model.distance(noise(2)), 0 * EVERYWHERE)
    np.testing.assert_array_equal(model.mean, before)


def test_a_colour_beside_the_line_of_the_waves_is_more_foreign_than_one_along_it():
    model = learnt([waves(i) for i in range(8)])
    along = picture_of(model.mean + np.array([20.0, 16.0, 8.0])[:, None, None])
    beside = picture_of(model.mean + np.array([-8.0, 0.0, 20.0])[:, None, None])  # a right angle
    assert np.median(model.distance(beside)) > 20 * np.median(model.distance(along))


def test_a_fish_in_the_first_picture_is_not_taken_for_background():
    picture = np.tile(noise(0), (1, 2, 2))
    picture[:, 80:86, 100:112] += 80
    model = BackgroundModel(picture, memory_frames=20.0)
    assert np.median(model.distance(picture)[80:86, 100:112]) > 25
    assert np.median(model.mean[:, 80:86, 100:112]) < 140


@settings(max_examples=10)
@given(seeds)
def test_where_a_fish_of_the_first_picture_has_gone_is_uncovered_and_where_one_is_now_is_not(
    seed: int,
):
    before, now = np.s_[20:40, 30:60], np.s_[36:56, 50:80]
    model = learnt([noise(seed)])
    model.mean[:, *before] = 60.0
    picture = noise(seed + 1)
    picture[:, *now] = 70
    foreign = np.zeros((HEIGHT, WIDTH), np.uint8)
    foreign[before], foreign[now] = 1, 1

    uncovered = model.uncover(picture, foreign)
    left = foreign.copy()
    left[now] = 0
    assert not uncovered[38:54, 52:78].any()  # but for a rim, since noise is averaged
    assert np.count_nonzero(uncovered) > 0.9 * np.count_nonzero(left)
    assert not uncovered[foreign == 0].any()
    np.testing.assert_array_equal(model.mean[:, uncovered], picture[:, uncovered])


def test_the_first_picture_is_remembered_for_as_long_as_the_memory_is():
    model = learnt([noise(i) for i in range(6)], memory_frames=6.0)
    assert model.is_young
    model.learn(noise(6), model.distance(noise(6)), EVERYWHERE)
    assert not model.is_young


def test_a_change_of_light_is_not_foreign():
    model = learnt([noise(i) for i in range(5)])
    lit = noise(7, level=135)
    model.learn(lit, 0 * EVERYWHERE, EVERYWHERE)
    assert model.distance(noise(8, level=135)).mean() < 6


def test_a_pixel_that_always_changes_becomes_tolerant_by_eight_times_at_most():
    model = learnt([noise(i) for i in range(3)])
    changing = (slice(None), slice(None), slice(0, None, 16))  # every sixteenth column
    for i in range(3, 60):
        picture = noise(i)
        picture[changing] = noise(i, level=120 + 60 * (-1) ** i)[changing]
        model.learn(picture, model.distance(picture), EVERYWHERE)
    distance = model.distance(picture_of(model.mean + 60))
    ratio = np.median(distance[:, 8::16]) / np.median(distance[changing[1:]])
    assert 5 < ratio < 9


def test_the_model_moves_with_the_view_and_fills_what_comes_into_it():
    model = learnt([noise(0), noise(1)])
    before = model.mean.copy()
    model.shift(5, -3)
    picture = noise(2)
    model.fill_unseen(picture)
    np.testing.assert_array_equal(model.mean[:, :-3, 5:], before[:, 3:, :-5])
    np.testing.assert_array_equal(model.mean[:, -3:], picture[:, -3:])
    np.testing.assert_array_equal(model.mean[:, :, :5], picture[:, :, :5])


@pytest.mark.parametrize("shape", [(2, 2), (1, 40), (40, 2)])
def test_a_plane_of_few_pixels_has_a_median(shape: tuple[int, int]):
    plane = np.full(shape, 7, np.uint8)
    np.testing.assert_array_equal(wide_median(plane, 5), plane)
