"""Square fits: what a fish shows is read off with nothing that turns it."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.body import ROOT_ROTATION, Body, joints_of
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.paper.torch_body import Rig
from stream_dmr.fitting.shape.space import reshaped, roundness
from stream_dmr.fitting.shape.stock import rolled_as_seen, square_pose, square_problem, unrolled
from stream_dmr.fitting.solver.problem import roll_and_slope
from stream_dmr.fitting.target import Target
from tests.support.shapes import crop_of, pose
from tests.support.stocks import TEMPLATE, TOWARD_CAMERA, broader

SETTINGS = FitMeshSettings(max_faces=600)


def square_fit(log_factor, roll):
    """A square fit to a fish so much broader than the template, that was drawn rolled.

    Returns the pose, its target, and the log of the factor on the template's breadth that shows.
    """
    fish = reshaped(TEMPLATE, broader(log_factor))
    narrower = float(np.log(np.hypot(np.cos(roll), roundness(fish) * np.sin(roll))))
    drawn = pose(np.random.default_rng(5), in_plane_rad=0.4, bend_rad=0.1)[0].numpy()
    crop = crop_of(torch.as_tensor(drawn)[None], Rig.from_template(fish))
    anchor = Target.from_crop(crop, plane_normal=TOWARD_CAMERA).anchor
    rolled = rolled_as_seen(unrolled(drawn, anchor), narrower, roundness(fish))
    crop = crop_of(torch.as_tensor(rolled)[None], Rig.from_template(fish))
    target = Target.from_crop(crop, plane_normal=TOWARD_CAMERA)
    problem = square_problem(SETTINGS, Body.from_template(TEMPLATE), target, scale_std=0.4)
    found = square_pose(problem, unrolled(rolled, target.anchor))
    return found, target, log_factor + narrower


@pytest.mark.parametrize("log_factor", [-0.15, 0.0, 0.2])
@pytest.mark.parametrize("roll", [0.0, 0.6])
def test_reads_the_breadth_that_shows(log_factor, roll):
    found, _, shown = square_fit(log_factor, roll)
    assert joints_of(found).log_scale.mean() == pytest.approx(shown, abs=0.07)


def test_nothing_is_rolled_slanted_twisted_or_arched():
    found, target, _ = square_fit(0.1, 0.6)
    assert abs(roll_and_slope(found, target.anchor)[0]) < 0.03
    assert np.abs(joints_of(found).rotation[:, :2]).max() < 0.05
    along = Rotation.from_rotvec(found[ROOT_ROTATION]).apply([1.0, 0.0, 0.0])
    assert abs(along @ TOWARD_CAMERA) < 0.06
