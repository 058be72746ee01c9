"""One mesh to two masks: a bent body has its length, whatever one of the cameras misses of it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Camera
from stream_dmr.fitting.body import (
    LOG_SIZE,
    ROOT_ROTATION,
    ROOT_TRANSLATION,
    Body,
    joints_of,
    rest_vector,
)
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.solver.outline import coverage, project, rim_edges
from stream_dmr.fitting.solver.spine import SPINE, deform
from stream_dmr.fitting.two_masks import Sight, TwoMaskFitter
from stream_dmr.geometry import arc_length
from stream_dmr.messages import CropQuality, FishCrop
from stream_dmr.template.template_file import load_template

SIZE, LENGTH_MM, DEPTH_MM = 128, 700.0, 4800.0
TEMPLATE = load_template("salmon")
BODY = Body.from_template(TEMPLATE)
CAMERA = Camera(
    width=SIZE,
    height=SIZE,
    K=np.array([[700.0, 0, (SIZE - 1) / 2], [0, 700, (SIZE - 1) / 2], [0, 0, 1]]),
    distortion=np.zeros(5),
)


def second_from_first(degrees):
    """A camera beside the first that looks at the same place."""
    R = Rotation.from_euler("y", -degrees, degrees=True).as_matrix()
    middle = np.array([0.0, 0.0, DEPTH_MM])
    return R, middle - R @ middle


def seen(pose, depth_mm):
    """The crop and the true midline (mm, in the camera's frame) of a pose."""
    anchor = CAMERA.middle_ray()
    points = deform(BODY, SPINE, pose)
    pixels = project(points[: BODY.num_vertices], anchor, CAMERA.K)
    mask = coverage(pixels, rim_edges(pixels, BODY), SIZE) >= 0.5
    crop = FishCrop(
        frame_index=0,
        timestamp_ns=0,
        track_id=1,
        bbox_xyxy_px=np.array([0.0, 0.0, SIZE, SIZE]),
        image=None,
        mask=mask,
        crop_camera=CAMERA,
        frame_camera=CAMERA,
        quality=CropQuality(
            touches_border=False,
            visible_fraction=1.0,
            sharpness=1.0,
            mask_area_px=float(mask.sum()),
        ),
    )
    return crop, (points[BODY.num_vertices + 3 :] + anchor) * depth_mm


def both_crops(bend_rad, turn, degrees, moved=(0.0, 0.0)):
    """What both cameras see; `moved`: in the second's picture, body lengths."""
    R, _ = second_from_first(degrees)
    pose = rest_vector(len(BODY.joints))
    joints_of(pose).rotation[:, 2] = [-bend_rad / 2, bend_rad / 2]
    pose[ROOT_ROTATION] = turn
    pose[LOG_SIZE] = np.log(LENGTH_MM / DEPTH_MM)
    other = pose.copy()
    other[ROOT_ROTATION] = (Rotation.from_matrix(R) * Rotation.from_rotvec(turn)).as_rotvec()
    other[ROOT_TRANSLATION] = moved
    return seen(pose, DEPTH_MM), seen(other, DEPTH_MM)


def sight(crop, drift=(0.0, 0.0, 0.0)):
    shape = Fitter(TEMPLATE, FitMeshSettings()).fit(crop, None).mesh.shape
    assert shape is not None
    return Sight(crop, shape, np.array(drift))


def fitter(degrees):
    return TwoMaskFitter(
        TEMPLATE,
        None,
        FitMeshSettings(),
        second_joints=TEMPLATE.joints,
        second_from_first=second_from_first(degrees),
    )


@settings(max_examples=8)
@given(
    st.floats(-1.2, 1.2),
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3, 3)),
    st.sampled_from([20.0, 35.0, 60.0]),
)
def test_a_turned_and_bent_body_has_its_length_and_place(bend_rad, turn, degrees):
    (crop, line_mm), (other, _) = both_crops(bend_rad, turn, degrees)
    found = fitter(degrees).fit(sight(crop), sight(other))
    assert found is not None
    assert arc_length(found.midline_mm) == pytest.approx(LENGTH_MM, rel=0.015)
    assert found.iou > 0.9
    gaps = np.linalg.norm(found.midline_mm[:, None] - line_mm, axis=2).min(axis=1)
    assert gaps.max() < 0.05 * LENGTH_MM


def test_a_fish_that_moves_between_the_pictures_has_its_length():
    """The later picture shows it a tenth of its length further on."""
    (crop, _), (other, _) = both_crops(0.6, (0.1, 0.2, 0.3), 35.0, moved=(0.1, 0.02))
    drift = -LENGTH_MM / DEPTH_MM * np.array([0.1, 0.02, 0.0])
    lengths_mm = [
        arc_length(found.midline_mm)
        for late in (drift, np.zeros(3))
        if (found := fitter(35.0).fit(sight(crop), sight(other, late))) is not None
    ]
    assert lengths_mm[0] == pytest.approx(LENGTH_MM, rel=0.01)
    assert abs(lengths_mm[1] - LENGTH_MM) > 2 * abs(lengths_mm[0] - LENGTH_MM)


@pytest.mark.parametrize("short", [0, 1])
def test_a_tail_that_one_mask_lacks_is_taken_from_the_other(short):
    crops = [crop for crop, _ in both_crops(0.6, (0.1, 0.2, 0.3), 35.0)]
    whole = sight(crops[short])
    line = project(whole.shape.midline - CAMERA.middle_ray(), CAMERA.middle_ray(), CAMERA.K)
    rows, columns = np.indices(crops[short].mask.shape)
    gaps = np.hypot(columns[..., None] - line[:, 0], rows[..., None] - line[:, 1])
    is_tail = gaps.argmin(axis=-1) > 0.9 * len(line)
    crops[short] = replace(crops[short], mask=crops[short].mask & ~is_tail)
    cut = sight(crops[short])
    single = arc_length(cut.shape.midline) / arc_length(whole.shape.midline)
    found = fitter(35.0).fit(sight(crops[0]), sight(crops[1]))
    assert found is not None
    both = arc_length(found.midline_mm) / LENGTH_MM
    assert abs(both - 1) < min(0.03, abs(single - 1))


def test_a_second_template_may_have_other_joints():
    """Each camera's run may have fitted its own."""
    (crop, _), (other, _) = both_crops(0.6, (0.1, 0.2, 0.3), 35.0)
    found = fitter(35.0).fit(sight(crop), sight(other))
    halibut = load_template("halibut")
    shape = Fitter(halibut, FitMeshSettings()).fit(other, None).mesh.shape
    by_halibut = TwoMaskFitter(
        TEMPLATE,
        None,
        FitMeshSettings(),
        second_joints=halibut.joints,
        second_from_first=second_from_first(35.0),
    ).fit(sight(crop), Sight(other, shape, np.zeros(3)))
    assert found is not None
    assert by_halibut is not None
    lengths_mm = [arc_length(one.midline_mm) for one in (found, by_halibut)]
    assert lengths_mm[0] == pytest.approx(lengths_mm[1], rel=0.01)
