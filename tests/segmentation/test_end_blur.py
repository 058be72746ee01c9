"""The ends of a fish that moves along while the shutter is open are blurred more than its sides."""

import cv2
import numpy as np
import pytest

from stream_dmr.segmentation.crop_geometry import end_blur

SIZE, LENGTH_PX = 128, 84


def fish(angle_deg: float) -> np.ndarray:
    """1 inside of a body like a fish's, finer than a crop."""
    mask = np.zeros((SIZE, SIZE), np.uint8)
    cv2.ellipse(mask, (64, 64), (LENGTH_PX // 2, 14), angle_deg, 0, 360, 1, -1)
    return mask > 0


def seen(mask: np.ndarray, *, way_px: float, angle_deg: float, noise: float = 3.0) -> np.ndarray:
    """Its picture, if it moves so far at this angle while the shutter is open."""
    body = mask.astype(np.float32)
    move = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    shifts = np.linspace(-0.5, 0.5, 33)[:, None] * way_px * move
    steps = [
        cv2.warpAffine(body, np.array([[1.0, 0.0, x], [0.0, 1.0, y]]), (SIZE, SIZE))
        for x, y in shifts
    ]
    shape = cv2.GaussianBlur(np.mean(steps, axis=0), (0, 0), 1.0)[..., None]
    colour = shape * (190, 200, 210) + (1 - shape) * (90, 80, 60)
    noisy = colour + np.random.default_rng(1).normal(0, noise, colour.shape)
    return noisy.clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("angle_deg", [0.0, 35.0, 90.0])
@pytest.mark.parametrize("way_px", [5.0, 8.0, 12.0])
def test_the_blur_of_the_ends_is_most_of_the_way(way_px: float, angle_deg: float):
    mask = fish(angle_deg)
    blur = end_blur(seen(mask, way_px=way_px, angle_deg=angle_deg), mask)
    assert blur is not None  # an end's slanted parts are less blurred
    assert 0.6 <= blur * LENGTH_PX / way_px <= 1.0


@pytest.mark.parametrize("angle_deg", [0.0, 35.0, 90.0])
def test_a_fish_at_rest_and_one_that_moves_across_have_sharp_ends(angle_deg: float):
    mask = fish(angle_deg)
    assert (end_blur(seen(mask, way_px=0.0, angle_deg=0.0), mask) or 0.0) < 0.035
    assert end_blur(seen(mask, way_px=10.0, angle_deg=angle_deg + 90), mask) == 0.0


def test_an_edge_without_contrast_tells_nothing():
    mask = fish(0.0)
    assert end_blur(np.full((SIZE, SIZE, 3), 90, np.uint8), mask) is None
    assert end_blur(seen(mask, way_px=4.0, angle_deg=0.0), np.zeros_like(mask)) is None
