"""The network in use: at the sizes that it takes, and on a simulated fish."""

import numpy as np
import pytest

from stream_dmr.networks.unet_interface import SIZES_PX
from stream_dmr.segmentation.segmenter import resize, segment_upright_as_well
from stream_dmr.segmentation.unet_segmenter import SHIPPED, UNetSegmenter
from stream_dmr.simulation.film import film
from stream_dmr.simulation.rail_scene import make_scene
from tests.support.random_unet import random_network, segmenter_of


@pytest.mark.parametrize("size", [32, 64, 128, 192])
def test_crops_of_many_sizes_are_segmented(size):
    segmenter = segmenter_of(random_network())
    image = np.random.default_rng(0).integers(0, 256, (size, size, 3), np.uint8)
    found = segmenter.segment(image, np.array([0.2, 0.3, 0.8, 0.7]) * size)
    assert found.probability.shape == (size, size)
    assert np.isfinite(found.probability).all()


@pytest.fixture(scope="module")
def network() -> UNetSegmenter:
    return UNetSegmenter.load(SHIPPED)


@pytest.fixture(scope="module")
def hanging() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A square picture of a fish on its line, its mask, and its box."""
    scene = make_scene(num_fish=1, num_frames=15, preset="clean", seed=3)
    shots = [shot for shot in film(scene) if any(b.visible_fraction == 1 for b in shot.boxes)]
    shot = shots[len(shots) // 2]
    x, y, w, h = shot.boxes[0].xywh_px
    side = round(1.3 * max(w, h))
    left, top = x + (w - side) // 2, y + (h - side) // 2
    square = np.s_[top : top + side, left : left + side]
    box = np.array([x - left, y - top, x - left + w, y - top + h], np.float64)
    return shot.image[square], shot.labels[square] > 0, box


@pytest.mark.parametrize("size", SIZES_PX)
def test_the_shipped_weights_find_a_fish_and_its_head(size, network, hanging):
    picture, truth, box = hanging
    side = len(picture)
    found = network.segment(resize(picture, size), box * size / side).resized(side)
    mask = found.probability > 0.5
    assert (mask & truth).sum() > 0.9 * (mask | truth).sum()
    assert found.ends.head_px[1] < found.ends.tail_px[1]  # it hangs by its mouth
    assert found.ends.confidence > 0.9


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_in_a_turned_picture_the_line_is_no_fish(turns, network, hanging):
    picture, truth, box = hanging
    scale, side = 128 / len(picture), len(picture)
    picture = np.ascontiguousarray(np.rot90(resize(picture, 128), turns))
    for _ in range(turns):
        box = np.array([box[1], side - box[2], box[3], side - box[0]])
    truth = np.rot90(truth, turns)
    found = segment_upright_as_well(network.segment, picture, box * scale).resized(side)
    plain = network.segment(picture, box * scale).resized(side)
    mask, more = found.probability > 0.5, plain.probability > 0.5
    assert (mask & truth).sum() > 0.9 * (mask | truth).sum()
    assert turns == 0 or (mask & ~truth).sum() < 0.8 * (more & ~truth).sum()
    up = np.array([[0, -1], [-1, 0], [0, 1], [1, 0]])[turns]
    assert up @ (found.ends.head_px - found.ends.tail_px) > 0.5 * side / 1.3
