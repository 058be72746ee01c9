"""What the benchmark compares must be comparable: its targets and its peer. No timings here."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from targets import draw_known, draw_pair, species_template

from stream_dmr.body import Body
from stream_dmr.fitting.contour.levenberg_marquardt import evaluate
from stream_dmr.fitting.target import Target
from stream_dmr.silhouette import project, silhouette
from stream_dmr.skinning import Rig, deform, spine

TEMPLATE = species_template()
TOWARD_CAMERA = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("seed", range(3))
def test_known_targets_can_be_matched(seed):
    body = Body.from_template(TEMPLATE)
    known = draw_known(body, size=128, seed=seed, most_bend_rad=2.0)
    target = Target.from_crop(known.crop, plane_normal=TOWARD_CAMERA)
    assert evaluate(body, 0, target, known.flat, True)[1] > 0.99


def test_pairs_are_whole_and_differ():
    pair = draw_pair(size=64, seed=0)
    for crop in (pair.before, pair.now):
        assert not crop.quality.touches_border
    assert (pair.before.mask != pair.now.mask).any()


def test_deodr_draws_our_silhouette_half_a_pixel_wider():
    peer = pytest.importorskip("deodr_solver", reason="needs the extra bench")
    body, rig = Body.from_template(TEMPLATE), Rig.from_template(TEMPLATE, device="cpu")
    known = draw_known(body, size=96, seed=1, most_bend_rad=1.0)
    vertices = deform(rig, torch.as_tensor(known.flat)[None], spine).vertices
    vertices = vertices + torch.tensor([0.0, 0.0, 1.0])
    pixels = project(vertices, torch.as_tensor(known.crop.crop_camera.K)).requires_grad_()
    neighbors, scene = peer._neighbors(rig.faces.numpy()), peer._scene(rig, 96)
    theirs = peer._Render.apply(pixels[0], vertices[0, :, 2].numpy(), scene, neighbors)
    ours = silhouette(pixels, rig, size=96)[0]
    # Growing the picture about its middle grows both areas at the same rate.
    about = (pixels[0] - pixels[0].mean(dim=0)).detach()
    rates = [
        (torch.autograd.grad(picture.sum(), pixels)[0][0] * about).sum()
        for picture in (ours, theirs)
    ]
    torch.testing.assert_close(rates[1], rates[0], rtol=0.1, atol=0.0)
    ours, theirs = ours.detach(), theirs.detach()
    assert (theirs[ours > 0.999] > 0.999).all()
    assert 0 < float(theirs.sum() - ours.sum()) < 0.06 * 96**2
