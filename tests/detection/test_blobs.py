"""Blobs of fish are kept; poles, lines and specks go."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from stream_dmr.detection.motion_detector import Refusal, fish_blobs


def drawn(draw: Callable[[np.ndarray], object]) -> list[np.ndarray]:
    picture = np.zeros((360, 480), np.uint8)
    draw(picture)
    fish, _ = fish_blobs(picture > 0, min_length_px=15.0, max_length_px=340.0)
    return fish


def test_lines_poles_and_specks_are_no_fish():
    assert not drawn(lambda p: cv2.line(p, (200, 0), (220, 180), 1, 2))
    assert not drawn(lambda p: cv2.line(p, (479, 10), (250, 170), 1, 6))
    assert not drawn(lambda p: cv2.circle(p, (100, 100), 4, 1, -1))
    assert not drawn(lambda p: cv2.rectangle(p, (20, 0), (460, 355), 1, -1))


def test_a_connected_gaff_is_removed_from_a_fish():
    def draw(picture: np.ndarray) -> None:
        cv2.ellipse(picture, (200, 200), (40, 14), 70, 0, 360, 1, -1)
        cv2.line(picture, (479, 60), (205, 205), 1, 5)

    [fish] = drawn(draw)
    x, y, w, h = cv2.boundingRect(fish.view(np.uint8))
    assert 160 < x < 190
    assert x + w < 260
    assert 150 < y < 165
    assert 235 < y + h < 245


def test_two_fish_that_touch_by_their_tails_are_two():
    def draw(picture: np.ndarray) -> None:
        cv2.ellipse(picture, (200, 120), (40, 14), 90, 0, 360, 1, -1)
        cv2.ellipse(picture, (203, 208), (40, 12), 90, 0, 360, 1, -1)
        cv2.line(picture, (200, 150), (203, 175), 1, 4)

    boxes = sorted(cv2.boundingRect(fish.view(np.uint8)) for fish in drawn(draw))
    assert len(boxes) == 2
    tops = sorted(top for _, top, _, _ in boxes)
    assert [abs(top - true) < 12 for top, true in zip(tops, (80, 168), strict=True)] == [True] * 2
    assert all(70 < height < 100 for _, _, _, height in boxes)


def test_a_tail_behind_a_thin_stalk_is_part_of_its_fish():
    def draw(picture: np.ndarray) -> None:
        cv2.ellipse(picture, (200, 200), (50, 18), 0, 0, 360, 1, -1)
        cv2.line(picture, (240, 200), (262, 200), 1, 5)
        cv2.ellipse(picture, (266, 200), (5, 14), 0, 0, 360, 1, -1)

    [fish] = drawn(draw)
    assert cv2.boundingRect(fish.view(np.uint8))[2] > 115


def hang(picture: np.ndarray) -> None:
    """A slender fish on a line: its thick part ends at row 200, its tail at row 240."""
    cv2.line(picture, (200, 0), (200, 150), 1, 2)
    cv2.ellipse(picture, (200, 170), (30, 9), 90, 0, 360, 1, -1)
    cv2.line(picture, (200, 195), (200, 236), 1, 4)
    cv2.ellipse(picture, (200, 236), (4, 6), 0, 0, 360, 1, -1)


def test_a_slender_fish_on_a_line_keeps_its_tail():
    [fish] = drawn(hang)
    _, y, _, h = cv2.boundingRect(fish.view(np.uint8))
    assert y > 125  # without the line
    assert y + h > 240


@pytest.mark.parametrize("top", [0, 20])
def test_a_fish_as_slender_as_a_pole_is_parted_from_its_line(top: int):
    def draw(picture: np.ndarray) -> None:
        cv2.line(picture, (200, top), (200, 160), 1, 2)
        cv2.ellipse(picture, (200, 200), (42, 4), 90, 0, 360, 1, -1)

    [fish] = drawn(draw)
    _, y, _, h = cv2.boundingRect(fish.view(np.uint8))
    assert y > 125
    assert y + h > 235


def test_the_end_of_a_gaff_before_a_fish_is_none_of_it():
    def draw(picture: np.ndarray) -> None:
        hang(picture)
        cv2.line(picture, (479, 60), (160, 185), 1, 5)

    [fish] = drawn(draw)
    x, _, w, _ = cv2.boundingRect(fish.view(np.uint8))
    assert x > 175
    assert x + w < 225


def test_a_bent_fish_seen_edge_on_is_kept_whole():
    for width in (6, 8, 10, 12):
        [fish] = drawn(lambda p, w=width: cv2.ellipse(p, (200, 200), (60, 40), 0, 0, 110, 1, w))
        _, _, w, h = cv2.boundingRect(fish.view(np.uint8))
        assert w > 75
        assert h > 38


def test_a_fish_seen_edge_on_is_kept():
    [fish] = drawn(lambda p: cv2.ellipse(p, (200, 200), (35, 3), 70, 0, 360, 1, -1))
    assert fish.sum() > 200


def test_every_refused_shape_is_counted_by_its_reason():
    picture = np.zeros((360, 480), np.uint8)
    cv2.circle(picture, (100, 100), 4, 1, -1)
    cv2.circle(picture, (140, 100), 4, 1, -1)
    cv2.line(picture, (200, 0), (220, 180), 1, 2)
    cv2.ellipse(picture, (200, 270), (40, 14), 0, 0, 360, 1, -1)
    fish, refused = fish_blobs(picture > 0, min_length_px=15.0, max_length_px=340.0)
    assert len(fish) == 1
    assert refused == {Refusal.SHORT: 2, Refusal.THIN: 1}
    _, refused = fish_blobs(picture > 0, min_length_px=5.0, max_length_px=60.0)
    assert refused[Refusal.LONG] == 1
