"""Histograms of colours: equal fish are alike, others are not, and pixels outside do not count."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.segmentation.tracking.appearance import dissimilarity, root_histogram

levels = st.tuples(*[st.integers(0, 255)] * 3)
WHOLE = np.ones((20, 20), bool)


def plain(colour: tuple[int, ...]) -> np.ndarray:
    return root_histogram(np.full((20, 20, 3), colour, np.uint8), WHOLE)


@given(levels, levels)
def test_dissimilarity_is_symmetric_and_from_0_to_1(one: tuple[int, ...], other: tuple[int, ...]):
    a, b = plain(one), plain(other)
    assert dissimilarity(a, b) == dissimilarity(b, a)
    assert 0 <= dissimilarity(a, b) <= 1
    assert dissimilarity(a, a) < 1e-5


@given(st.integers(0, 245), st.integers(0, 10))
def test_a_slight_change_of_light_is_no_other_fish(level: int, change: int):
    assert dissimilarity(plain((level,) * 3), plain((level + change,) * 3)) < 0.3
    assert dissimilarity(plain((level,) * 3), plain(((level + 128) % 256,) * 3)) > 0.9


def test_what_is_outside_the_silhouette_does_not_count():
    region = np.full((40, 40, 3), 200, np.uint8)
    silhouette = np.zeros((40, 40), bool)
    silhouette[10:30, 5:35] = True
    region[silhouette] = (30, 60, 90)
    assert dissimilarity(root_histogram(region, silhouette), plain((30, 60, 90))) < 1e-5


def test_an_empty_silhouette_is_like_nothing():
    empty = root_histogram(np.full((20, 20, 3), 90, np.uint8), ~WHOLE)
    assert dissimilarity(empty, plain((90, 90, 90))) == 1
