"""Fits along tracks with several candidate shapes: a fish is given the one its masks prefer."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.tracks import TrackFitter
from tests.support.stocks import TEMPLATE, broader, candidates, fish_of, forms, tapered

SETTINGS = FitMeshSettings(max_faces=600)


def shapes_of(fitter, fish):
    return [fitter.fit(sample.crop).shape for sample in fish.samples]


@pytest.mark.parametrize(("hang", "lean"), [("camera", 0.0), ("plane", 0.3)])
def test_fish_hang_facing_the_camera_or_in_the_plane(hang, lean):
    plane = ReferencePlane(
        rotation=Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix(),
        translation_mm=np.array([0.0, 0.0, 5000.0]),
    )
    fitter = TrackFitter(
        TEMPLATE,
        SETTINGS.model_copy(update={"hang": hang}),
        calibration=Calibration(camera=Camera.nominal(width=640, height=480), plane=plane),
    )
    (normal,) = [fitter.plane_normal for fitter in fitter.fitters]
    assert np.arccos(abs(normal[2])) == pytest.approx(lean)


@pytest.mark.parametrize(("log_factor", "candidate"), [(-0.3, 0), (0.3, 1)])
def test_a_fish_is_given_the_shape_that_it_has(log_factor, candidate):
    shapes = candidates(fore=tapered(-0.3), aft=tapered(0.3))
    fitter = TrackFitter(TEMPLATE, SETTINGS, calibration=None, candidates=shapes)
    shapes = shapes_of(fitter, fish_of(tapered(log_factor), track_id=4, num_frames=4))
    assert shapes[-1].candidate == candidate
    assert shapes[-1].iou > 0.9
    assert shapes[-1].shape_std_ratio > 0


def test_masks_that_are_wrong_alike_are_no_more_evidence_than_one():
    shapes = candidates(fore=tapered(-0.1), aft=tapered(0.1))
    fitter = TrackFitter(TEMPLATE, SETTINGS, calibration=None, candidates=shapes)
    (sample,) = fish_of(tapered(0.1), track_id=4, num_frames=1).samples
    margins = []
    for _ in range(3):
        fitter.fit(sample.crop)
        margins.append(np.ptp(fitter.against(4)))
    assert margins[0] > 1
    assert margins == pytest.approx([margins[0]] * 3, rel=0.2)


def test_the_paper_s_loss_tells_shapes_apart_as_well():
    shapes = candidates(fore=tapered(-0.3), aft=tapered(0.3))
    settings = SETTINGS.model_copy(update={"prior_weight": 0.0})
    fitter = TrackFitter(TEMPLATE, settings, calibration=None, candidates=shapes)
    shapes = shapes_of(fitter, fish_of(tapered(0.3), track_id=4, num_frames=4))
    assert shapes[-1].candidate == 1
    assert shapes[-1].iou > 0.9


def test_where_masks_say_nothing_yet_the_larger_share_counts():
    """One candidate twice: only the shares distinguish them."""
    twins = candidates((0.1, 0.9), one=broader(0.0), other=broader(0.0))
    fitter = TrackFitter(TEMPLATE, SETTINGS, calibration=None, candidates=twins)
    (shape,) = shapes_of(fitter, fish_of(broader(0.0), track_id=4, num_frames=1))
    assert shape.candidate == 1


def test_without_candidates_a_fish_has_the_template_s_own_shape():
    fitter = TrackFitter(TEMPLATE, SETTINGS, calibration=None)
    (shape,) = shapes_of(fitter, fish_of(broader(0.0), track_id=4, num_frames=1))
    assert shape.candidate is None
    assert shape.shape_std_ratio > 0  # individuals differ all the same


def test_less_is_known_of_a_length_where_the_stock_is_not_known():
    sample = fish_of(broader(0.0), track_id=4, num_frames=1)
    own = TrackFitter(TEMPLATE, SETTINGS, calibration=None)
    guessed = TrackFitter(TEMPLATE, SETTINGS, calibration=None, candidates=forms())
    (known,), (unknown,) = shapes_of(own, sample), shapes_of(guessed, sample)
    assert unknown.shape_std_ratio > known.shape_std_ratio


def test_less_is_known_of_a_length_where_the_fish_may_be_of_another_stock():
    sample = fish_of(broader(0.0), track_id=4, num_frames=1)
    stds = []
    for share in (0.55, 1 - 1e-12):
        pair = candidates((share, 1 - share), this=tapered(-0.12), that=tapered(0.12))
        fitter = TrackFitter(TEMPLATE, SETTINGS, calibration=None, candidates=pair)
        (shape,) = shapes_of(fitter, sample)
        stds.append((shape.candidate, shape.shape_std_ratio))
    (doubted, more), (certain, less) = stds
    assert doubted == certain
    assert more > less


def test_a_solver_that_scans_no_sizes_says_nothing_of_the_shape():
    settings = SETTINGS.model_copy(update={"scan_iterations": 0})
    (shape,) = shapes_of(
        TrackFitter(TEMPLATE, settings, calibration=None),
        fish_of(broader(0.0), track_id=4, num_frames=1),
    )
    assert shape.shape_std_ratio is None
