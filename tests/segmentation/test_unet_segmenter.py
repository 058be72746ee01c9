"""The network in use: at the sizes that it takes, and on a simulated fish."""

import numpy as np
import pytest

from stream_dmr.networks.unet_interface import SIZES_PX
from stream_dmr.segmentation.segmenter import resize
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


@pytest.mark.parametrize("size", SIZES_PX)
def test_the_shipped_weights_find_a_fish_and_its_head(size):
    scene = make_scene(num_fish=1, num_frames=15, preset="clean", seed=3)
    segmenter = UNetSegmenter.load(SHIPPED)
    shots = [shot for shot in film(scene) if any(b.visible_fraction == 1 for b in shot.boxes)]
    shot = shots[len(shots) // 2]
    x, y, w, h = shot.boxes[0].xywh_px
    side = round(1.3 * max(w, h))
    left, top = x + (w - side) // 2, y + (h - side) // 2
    box = np.array([x - left, y - top, x - left + w, y - top + h], np.float64)
    picture = resize(shot.image[top : top + side, left : left + side], size)
    found = segmenter.segment(picture, box * size / side).resized(side)
    mask, truth = found.probability > 0.5, shot.labels[top : top + side, left : left + side] > 0
    assert (mask & truth).sum() > 0.9 * (mask | truth).sum()
    assert found.ends.head_px[1] < found.ends.tail_px[1]  # it hangs by its mouth
    assert found.ends.confidence > 0.9
