"""Histograms of colours: equal fish are alike, others are not, and pixels outside do not count."""

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.tracking.observation import (
    Colours,
    colours_of,
    dissimilarity,
    dissimilarity_if_covered,
    root_histogram,
)

levels = st.tuples(*[st.integers(0, 255)] * 3)
WHOLE = np.ones((20, 20), bool)


def plain(colour: tuple[int, ...], silhouette: np.ndarray | None = WHOLE) -> Colours:
    return colours_of(np.full((20, 20, 3), colour, np.uint8), silhouette)


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
    assert dissimilarity(colours_of(region, silhouette), plain((30, 60, 90))) < 1e-5


def test_an_empty_silhouette_is_like_nothing():
    empty = plain((90, 90, 90), ~WHOLE)
    assert dissimilarity(empty, plain((90, 90, 90))) == 1


def test_at_the_edge_like_is_compared_with_like():
    """A thin fish is little of its box: its silhouette's colours are not those of the box."""
    region = np.full((40, 40, 3), 200, np.uint8)
    thin = np.zeros((40, 40), bool)
    thin[18:22] = True
    region[thin] = (30, 60, 90)
    outlined, boxed = colours_of(region, thin), colours_of(region, None)
    assert dissimilarity(outlined, boxed) > 0.3
    assert dissimilarity(outlined, boxed, is_cut_off=True) < 1e-5
    for is_cut_off in (False, True):
        alone = plain((30, 60, 90))
        assert dissimilarity(outlined, alone, is_cut_off=is_cut_off) < 1e-5


def striped(fish: tuple[int, ...], gaff: tuple[int, ...], rows: int) -> Colours:
    """A silhouette of 20 rows, so many of which show a gaff before the fish."""
    region = np.full((20, 20, 3), fish, np.uint8)
    region[:rows] = gaff
    return colours_of(region, WHOLE)


@given(st.integers(1, 9))
def test_what_covers_less_than_half_of_a_fish_is_left_out(rows: int):
    bare, covered = plain((30, 60, 90)), striped((30, 60, 90), (40, 200, 240), rows)
    for views in ((bare, covered), (covered, bare)):  # it comes, or it goes
        assert dissimilarity_if_covered(*views) < 1e-3
    assert dissimilarity(bare, covered) > 0.01 * rows


def test_another_fish_is_no_covered_one():
    seen = plain((30, 60, 90))
    assert dissimilarity_if_covered(seen, plain((200, 60, 30))) == 1
    assert dissimilarity_if_covered(seen, striped((30, 60, 90), (200, 60, 30), 12)) > 0.3
    assert dissimilarity_if_covered(plain((200, 60, 30)), striped((30, 60, 90), (0, 0, 0), 5)) == 1
    assert dissimilarity_if_covered(seen, plain((30, 60, 90), None)) == 1


def test_of_a_box_alone_the_corners_do_not_count():
    region = np.full((30, 60, 3), 20, np.uint8)
    cv2.ellipse(region, (30, 15), (30, 15), 0, 0, 360, (90, 90, 90), cv2.FILLED)
    alone = root_histogram(np.full((9, 9, 3), 90, np.uint8), np.ones((9, 9), bool))
    np.testing.assert_allclose(colours_of(region, None).middle, alone, atol=1e-6)
