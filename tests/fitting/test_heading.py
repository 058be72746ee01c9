"""Which end is the head: cues that err are outvoted, fits that err are found out."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.camera import crop_from_frame
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.heading import HeadMemory
from stream_dmr.fitting.paper.skinning import Rig
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.messages import FishEnds
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.template.template import load_template
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
def test_a_first_cue_is_taken_as_it_is_but_never_for_certain(up, confidence):
    weighed = HeadMemory().weigh(cue(is_up=up, confidence=confidence))
    assert is_up(weighed) == up
    assert np.isclose(weighed.confidence, min(confidence, 0.95))


@given(st.lists(st.tuples(st.booleans(), st.floats(0.5, 1.0)), min_size=1, max_size=40))
def test_it_says_what_the_odds_of_all_cues_say_of_a_fit_that_holds_still(cues):
    """Beside the sum written out: of log odds, the older the less."""
    memory = HeadMemory()
    for up, confidence in cues:
        weighed = memory.weigh(cue(is_up=up, confidence=confidence))
        memory.follow(fit(is_up=True))
    sure = np.minimum([confidence for _, confidence in cues], 0.95)
    odds = np.log(sure / (1 - sure)) * [1 if up else -1 for up, _ in cues]
    total = sum(one * 0.98**age for age, one in enumerate(odds[::-1]))
    if abs(total) > 1e-9:
        assert is_up(weighed) == (total > 0)
        assert np.isclose(weighed.confidence, 1 / (1 + np.exp(-abs(total))))


def test_a_fit_that_turns_round_by_itself_does_not_turn_what_was_known():
    memory = HeadMemory()
    for _ in range(5):
        memory.weigh(cue(is_up=True))
        memory.follow(fit(is_up=True))
    memory.follow(fit(is_up=False))
    unsure = memory.weigh(cue(is_up=False, confidence=0.6))
    assert is_up(unsure)
    assert unsure.confidence > 0.99


def test_without_a_cue_nothing_is_said():
    memory = HeadMemory()
    memory.follow(fit(is_up=True))
    assert memory.weigh(None) is None


@pytest.mark.parametrize("confidence", [0.0, np.nan, np.inf])
def test_a_confidence_that_none_can_be_says_nothing(confidence):
    """A damaged recording is replayed too."""
    ends = HeadMemory().weigh(cue(is_up=True, confidence=confidence))
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
def test_a_fit_obeys_a_segmenter_that_is_sure(template, warm):
    """Also where the outline says otherwise, and where a search from afar would turn round."""
    fitter, rig = Fitter(template, FitMeshSettings()), Rig.from_template(template)
    for seed in range(6):
        crop = crop_of(pose(np.random.default_rng(seed), in_plane_rad=seed), rig, size=64)
        free = fitter.fit(crop, None)
        ends = swapped(ends_of(free.mesh, crop))
        told = fitter.fit(replace(crop, ends=ends), free.best if warm else None).mesh
        assert told.report.cold_start
        forward = np.subtract(*told.shape.keypoints_px[[0, 2]])
        assert forward @ (ends.head_px - ends.tail_px) > 0


def test_a_track_that_begins_turned_round_is_turned_back_by_the_frames_after():
    crop = crop_of(pose(np.random.default_rng(5), in_plane_rad=0.4), Rig.from_template(TEMPLATE))
    node = FitMesh(FitMeshSettings(), template=TEMPLATE, calibration=None)
    ends = ends_of(node.step(replace(crop, track_id=7))[0], crop)
    heads = []
    for says_so in (True, False, False, False, True, False):
        cued = replace(crop, ends=ends if says_so else swapped(ends))
        forward = np.subtract(*node.step(cued)[0].shape.keypoints_px[[0, 2]])
        heads.append(bool(forward @ (ends.head_px - ends.tail_px) > 0))
    assert heads == [True, True, False, False, False, False]  # two to one
