"""The network in use: as trained, at any crop size, and on a simulated fish."""

import numpy as np
import pytest
import torch

from stream_dmr.segmentation.network.unet import normalise
from stream_dmr.segmentation.network.unet_segmenter import UNetSegmenter
from stream_dmr.segmentation.network.unet_weights import SHIPPED
from stream_dmr.simulation.film import film
from stream_dmr.simulation.rail_scene import make_scene
from tests.support.random_unet import random_inputs, random_network


@torch.no_grad()
def test_inference_gives_what_the_trained_network_gives():
    network = random_network()
    images, boxes = random_inputs()
    x = normalise(torch.from_numpy(images).float(), torch.from_numpy(boxes))
    mask_logits, ends_logits = network(x)
    probability, log_ends = UNetSegmenter(network).segment_batch(images, boxes)
    np.testing.assert_allclose(probability, torch.sigmoid(mask_logits), atol=1e-3)
    expected = torch.log_softmax(ends_logits.flatten(2), dim=2).numpy()
    np.testing.assert_allclose(log_ends.reshape(expected.shape), expected, rtol=1e-3, atol=1e-3)
    assert any(isinstance(m, torch.nn.BatchNorm2d) for m in network.modules())  # still trainable


@pytest.mark.parametrize("size", [32, 64, 128, 200])
def test_crops_of_any_size_are_segmented(size):
    segmenter = UNetSegmenter(random_network())
    image = np.random.default_rng(0).integers(0, 256, (size, size, 3), np.uint8)
    threads = torch.get_num_threads()
    found = segmenter.segment(image, np.array([0.2, 0.3, 0.8, 0.7]) * size)
    assert found.probability.shape == (size, size)
    assert np.isfinite(found.probability).all()
    assert torch.get_num_threads() == threads


def test_the_shipped_weights_find_a_fish_and_its_head():
    scene = make_scene(num_fish=1, num_frames=15, preset="clean", seed=3)
    segmenter = UNetSegmenter.load(SHIPPED)
    shots = [shot for shot in film(scene) if any(b.visible_fraction == 1 for b in shot.boxes)]
    shot = shots[len(shots) // 2]
    x, y, w, h = shot.boxes[0].xywh_px
    side = round(1.3 * max(w, h))
    left, top = x + (w - side) // 2, y + (h - side) // 2
    found = segmenter.segment(
        shot.image[top : top + side, left : left + side],
        np.array([x - left, y - top, x - left + w, y - top + h], np.float64),
    )
    mask, truth = found.probability > 0.5, shot.labels[top : top + side, left : left + side] > 0
    assert (mask & truth).sum() > 0.9 * (mask | truth).sum()
    assert found.ends.head_px[1] < found.ends.tail_px[1]  # it hangs by its mouth
    assert found.ends.confidence > 0.9
