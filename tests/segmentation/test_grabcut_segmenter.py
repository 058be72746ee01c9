"""GrabCut finds a textured fish in its box, and survives any box."""

import cv2
import numpy as np
import pytest

from stream_dmr.segmentation.open_segmenter import segment_box


def fish_on_sea(*, seed=0, size=(240, 180), axes=(70, 22), angle=30.0, center=(120, 90)):
    """A textured ellipse on textured water, and its true mask."""
    rng = np.random.default_rng(seed)
    truth = np.zeros((size[1], size[0]), np.uint8)
    cv2.ellipse(truth, center, axes, angle, 0, 360, 1, cv2.FILLED)
    sea = np.array([120, 90, 60]) + rng.normal(0, 8, (size[1], size[0], 3))
    fish = np.array([90, 140, 170]) + rng.normal(0, 12, (size[1], size[0], 3))
    image = np.where(truth[..., None] == 1, fish, sea).clip(0, 255).astype(np.uint8)
    return cv2.GaussianBlur(image, (0, 0), 1.0), truth == 1


def box_around(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.min() - 3, rows.min() - 3, columns.max() + 4, rows.max() + 4], float)


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0])
def test_grabcut_finds_a_fish_in_its_box(angle):
    image, truth = fish_on_sea(angle=angle)
    mask = segment_box(image, box_around(truth))
    overlap = (mask & truth).sum() / (mask | truth).sum()
    assert overlap > 0.92  # the blurred rim goes to the fish: a pixel too wide all around
    np.testing.assert_array_equal(segment_box(image, box_around(truth)), mask)


@pytest.mark.parametrize(
    "box",
    [
        (0, 0, 240, 180),  # the whole picture: no sea outside of the box
        (-500, -500, 1500, 1500),
        (100, 80, 101, 81),
        (200.5, 0.25, 700.5, 30.25),
        (239, 179, 289, 229),
    ],
)
@pytest.mark.parametrize("is_flat", [False, True])
def test_any_box_gives_a_mask_of_the_image(box, is_flat):
    image, truth = fish_on_sea()
    image = np.full_like(image, 99) if is_flat else image
    mask = segment_box(image, np.array(box, np.float64))
    assert mask.shape == truth.shape
