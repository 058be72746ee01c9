"""Which end is the head: wrong cues are outvoted, reversed fits are noticed."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.camera import crop_from_frame
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.heading import HeadTracker
from stream_dmr.fitting.paper.torch_body import Rig
from stream_dmr.messages import FishEnds
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.template.template_file import load_template
from tests.support.shapes import FRAME_CAMERA, STRAIGHT, crop_of, fish_template, pose

TEMPLATE = fish_template(points=STRAIGHT)
UP = np.array([0.0, -40.0])


def cue(*, is_up, confidence=0.99):
    head, tail = (UP, -UP) if is_up else (-UP, UP)
    return FishEnds(head_px=head, tail_px=tail, confidence=confidence)


def fit(*, is_up):
    sign = 1 if is_up else -1
    return np.array([sign * UP, np.zeros(2), -sign * UP])


def is_up(ends):
    return bool((ends.head_px - ends.tail_px) @ UP > 0)


@given(st.booleans(), st.floats(0.5, 1.0))
def test_first_cue_is_kept_with_limited_confidence(up, confidence):
    corrected = HeadTracker().correct(cue(is_up=up, confidence=confidence))
    assert is_up(corrected) == up
    assert np.isclose(corrected.confidence, min(confidence, 0.95))


@given(st.lists(st.tuples(st.booleans(), st.floats(0.5, 1.0)), min_size=1, max_size=40))
def test_head_follows_decayed_log_odds_of_all_cues(cues):
    """Slow twin: the sum of the cues' log odds written out, each decayed by its age."""
    tracker = HeadTracker()
    for up, confidence in cues:
        corrected = tracker.correct(cue(is_up=up, confidence=confidence))
        tracker.update(fit(is_up=True))
    limited = np.minimum([confidence for _, confidence in cues], 0.95)
    odds = np.log(limited / (1 - limited)) * [1 if up else -1 for up, _ in cues]
    total = sum(one * 0.98**age for age, one in enumerate(odds[::-1]))
    if abs(total) > 1e-9:
        assert is_up(corrected) == (total > 0)
        assert np.isclose(corrected.confidence, 1 / (1 + np.exp(-abs(total))))


def test_fit_that_reverses_keeps_the_known_head():
    tracker = HeadTracker()
    for _ in range(5):
        tracker.correct(cue(is_up=True))
        tracker.update(fit(is_up=True))
    tracker.update(fit(is_up=False))
    unsure = tracker.correct(cue(is_up=False, confidence=0.6))
    assert is_up(unsure)
    assert unsure.confidence > 0.99


def test_without_cue_there_is_no_answer():
    tracker = HeadTracker()
    tracker.update(fit(is_up=True))
    assert tracker.correct(None) is None


@pytest.mark.parametrize("confidence", [0.0, np.nan, np.inf])
def test_impossible_confidence_is_bounded(confidence):
    """A damaged recording is replayed too."""
    ends = HeadTracker().correct(cue(is_up=True, confidence=confidence))
    assert 0.5 <= ends.confidence <= 0.95


def ends_of(fitted, crop):
    head, _, tail = crop_from_frame(
        fitted.shape.keypoints_px, crop_camera=crop.crop_camera, frame_camera=FRAME_CAMERA
    )
    return FishEnds(head_px=head, tail_px=tail, confidence=0.99)


def swapped(ends):
    return replace(ends, head_px=ends.tail_px, tail_px=ends.head_px)


@pytest.mark.parametrize("template", [TEMPLATE, load_template("cod")], ids=["fish", "cod"])
@pytest.mark.parametrize("warm", [False, True])
def test_fit_has_its_head_where_a_confident_segmenter_sees_it(template, warm):
    """Also where the outline says otherwise, and where a search from afar would turn round."""
    fitter, rig = Fitter(template, FitMeshSettings()), Rig.from_template(template)
    for seed in range(6):
        crop = crop_of(pose(np.random.default_rng(seed), in_plane_rad=seed), rig, size=64)
        free = fitter.fit(crop, None)
        ends = swapped(ends_of(free.mesh, crop))
        fitted = fitter.fit(replace(crop, ends=ends), free.best if warm else None).mesh
        assert fitted.report.cold_start
        forward = np.subtract(*fitted.shape.keypoints_px[[0, 2]])
        assert forward @ (ends.head_px - ends.tail_px) > 0


def test_later_frames_correct_a_reversed_first_frame():
    crop = crop_of(pose(np.random.default_rng(5), in_plane_rad=0.4), Rig.from_template(TEMPLATE))
    node = FitMesh(FitMeshSettings(), template=TEMPLATE, calibration=None)
    ends = ends_of(node.step(replace(crop, track_id=7))[0], crop)
    heads = []
    for is_right in (True, False, False, False, True, False):
        cued = replace(crop, ends=ends if is_right else swapped(ends))
        forward = np.subtract(*node.step(cued)[0].shape.keypoints_px[[0, 2]])
        heads.append(bool(forward @ (ends.head_px - ends.tail_px) > 0))
    assert heads == [True, True, False, False, False, False]  # two to one
