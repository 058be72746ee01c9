"""Priors of a fit: what an outline hides is held by a std of its own."""

import numpy as np
import torch

from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.paper.torch_body import Rig
from stream_dmr.localization.localize_fish import bow_ratio
from tests.support.shapes import STRAIGHT, crop_of, fish_template, pose

TOWARD_CAMERA = np.array([0.0, 0.0, 1.0])
TEMPLATE = fish_template(points=STRAIGHT)


def fitted(*, bent_rad, settings):
    """The fit of a fish each joint of which is turned by these angles about its own y and z."""
    flat = pose(np.random.default_rng(0), in_plane_rad=0.3, bend_rad=0.0)
    flat[0, 6:].view(2, 13)[:, :3] = torch.tensor([0.0, *bent_rad])
    crop = crop_of(flat, Rig.from_template(TEMPLATE))
    mesh = Fitter(TEMPLATE, settings, plane_normal=TOWARD_CAMERA).fit(crop, None).mesh
    assert mesh.shape is not None
    return mesh.shape


def test_a_fish_that_may_not_arch_is_fitted_flat_and_still_bends():
    free, flat = FitMeshSettings(), FitMeshSettings(arch_std_rad=0.01)
    arched = [
        bow_ratio(fitted(bent_rad=(0.4, 0.0), settings=settings).midline, TOWARD_CAMERA)
        for settings in (free, flat)
    ]
    assert arched[1] < 0.5 * arched[0]
    assert fitted(bent_rad=(0.0, 0.4), settings=flat).iou > 0.97
