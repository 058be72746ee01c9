"""Evidence: a shape that only fits rolled in one way has less of it than one that fits at rest."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.body import ROOT_ROTATION, Body
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.space import reshaped
from stream_dmr.fitting.size import nats_against
from stream_dmr.fitting.solver.descent import COLD_DAMPING, descend
from stream_dmr.fitting.solver.problem import Options, Problem, roll_and_slope
from stream_dmr.fitting.target import Target
from tests.support.stocks import TEMPLATE, TOWARD_CAMERA, broader, fish_of

SETTINGS = FitMeshSettings(max_faces=600)


def fitted(log_breadth, sample, *, rolled_by=0.0):
    """The problem of a body on a mask, and the pose that a descent from the true one ends in."""
    target = Target.from_crop(sample.crop, plane_normal=TOWARD_CAMERA)
    body = Body.from_template(reshaped(TEMPLATE, broader(log_breadth)))
    problem = Problem.from_settings(SETTINGS, body, target, with_smoothness=False)
    start = sample.pose.copy()
    turned = Rotation.from_rotvec(start[ROOT_ROTATION]) * Rotation.from_euler("x", rolled_by)
    start[ROOT_ROTATION] = turned.as_rotvec()
    nothing = np.zeros(len(start), np.bool_)
    return problem, descend(problem, start, nothing, Options(60, 1e-9, COLD_DAMPING))


@pytest.mark.parametrize("track_id", [3, 8])
def test_a_broad_body_that_rolls_to_fit_has_less_evidence_than_the_true_one(track_id):
    [sample] = fish_of(broader(0.0), track_id=track_id, num_frames=1).samples
    own, found = fitted(0.0, sample)
    broad, rolled = fitted(0.25, sample, rolled_by=0.6)
    assert abs(roll_and_slope(rolled.parameters, broad.target.anchor)[0]) > 0.3
    by_evidence = nats_against(broad, rolled.parameters, nat=SETTINGS.nat) - nats_against(
        own, found.parameters, nat=SETTINGS.nat
    )
    assert by_evidence > 0


def test_evidence_is_the_same_for_the_same_pose():
    [sample] = fish_of(broader(0.0), track_id=1, num_frames=1).samples
    problem, found = fitted(0.0, sample)
    once, again = (nats_against(problem, found.parameters, nat=SETTINGS.nat) for _ in range(2))
    assert once == again
    assert np.isfinite(once)


def test_a_pose_in_which_something_overflows_has_no_evidence_and_no_warning(recwarn):
    [sample] = fish_of(broader(0.0), track_id=1, num_frames=1).samples
    problem, found = fitted(0.0, sample)
    pose = found.parameters.copy()
    pose[-6] = 800.0
    assert np.isnan(nats_against(problem, pose, nat=SETTINGS.nat))
    assert not recwarn.list
