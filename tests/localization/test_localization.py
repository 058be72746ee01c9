from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Calibration, Camera, ReferencePlane
from stream_dmr.geometry import arc_length, misfit
from stream_dmr.localization.localize_fish import (
    LocalizeSettings,
    Unlocatable,
    bow_ratio,
    intersect,
    localize,
    mask_std_ratio,
    quality_refusal,
)
from stream_dmr.messages import CropQuality, FittedMesh, FittedShape, LossTerms
from stream_dmr.nodes.localize import Localize
from stream_dmr.reasons import Reason

# The area is that of no fish here: smaller than any.
GOOD = CropQuality(touches_border=False, visible_fraction=1.0, sharpness=9.0, mask_area_px=1.0)


def make_calibration(*, tilt_rad=0.0, depth_mm=2500.0, distortion=(0, 0, 0, 0, 0)):
    """A camera that looks at a plane tilted about its x axis, `depth_mm` along the optical axis."""
    K = np.array([[1400.0, 0, 960], [0, 1390.0, 540], [0, 0, 1]])
    camera = Camera(width=1920, height=1080, K=K, distortion=np.array(distortion, np.float64))
    plane = ReferencePlane(
        rotation=Rotation.from_rotvec([tilt_rad, 0, 0]).as_matrix(),
        translation_mm=np.array([0.0, 0.0, depth_mm]),
    )
    return Calibration(camera=camera, plane=plane)


def make_shape(midline_mm, center_mm, camera, *, scale=1e-3, shift=0.0, iou=0.95, std_ratio=0.02):
    """What a perfect fit returns: true pixels, and the true shape at an arbitrary scale."""
    keypoints_mm = np.stack([midline_mm[0], center_mm, midline_mm[-1]])
    return FittedShape(
        parameters=np.zeros(1),
        vertices=np.zeros((4, 3)),
        keypoints=scale * keypoints_mm + shift,
        keypoints_px=camera.project(keypoints_mm),
        midline=scale * midline_mm + shift,
        iou=iou,
        losses=LossTerms(
            iou=0.0, boundary=0.0, scale=0.0, translation=0.0, normal=0.0, laplacian=0.0
        ),
        covariance=np.zeros((1, 1)),
        length_std_ratio=std_ratio,
    )


def make_mesh(shape, *, quality=GOOD, refusal=""):
    if shape is not None and quality is GOOD:  # a mask a fifth as broad as long
        area = 0.2 * arc_length(shape.keypoints_px) ** 2
        quality = replace(GOOD, mask_area_px=area)
    return FittedMesh(
        frame_index=7,
        timestamp_ns=280_000_000,
        track_id=3,
        shape=shape,
        report=None,
        quality=quality,
        refusal=refusal,
    )


def straight_fish(calibration, *, direction=(1.0, 0.2, 0.3), length_mm=700.0, **kwargs):
    """Half of the fish on each side of a center on the optical axis and on the plane."""
    center = np.array([0.0, 0.0, calibration.plane.translation_mm[2]])
    unit = np.asarray(direction) / np.linalg.norm(direction)
    midline = center + np.linspace(-0.5, 0.5, 11)[:, None] * length_mm * unit
    return make_mesh(make_shape(midline, center, calibration.camera, **kwargs))


def bent_fish(calibration, *, bend_rad=1.8, length_mm=700.0, **kwargs):
    """An arc across the optical axis, with its center on the axis and on the plane."""
    angles = np.linspace(-0.5, 0.5, 21)[:-1] * bend_rad
    steps = length_mm / 20 * np.stack([np.cos(angles), np.sin(angles), np.zeros(20)], axis=1)
    midline = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    center = np.array([0.0, 0.0, calibration.plane.translation_mm[2]])
    midline += center - midline[10]
    return make_mesh(make_shape(midline, center, calibration.camera, **kwargs))


def localized(mesh, calibration, **changes):
    return localize(mesh, settings=LocalizeSettings(**changes), calibration=calibration)


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)


@st.composite
def exact_scenes(draw):
    """A random camera, plane and bent fish whose center lies exactly on that plane."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    focal = rng.uniform(700, 4000)
    middle = rng.uniform([700, 300], [1200, 700])
    K = np.array([[focal, 0, middle[0]], [0, rng.uniform(0.9, 1.1) * focal, middle[1]], [0, 0, 1]])
    distortion = rng.uniform(-1, 1, 5) * [0.15, 0.05, 2e-3, 2e-3, 0.01]
    camera = Camera(width=1920, height=1080, K=K, distortion=distortion)

    center = rng.uniform(800, 6000) * np.array([*rng.uniform(-0.25, 0.25, 2), 1.0])
    rotation = Rotation.random(rng=rng).as_matrix()
    assume(abs(rotation[:, 2] @ center) > 0.1 * np.linalg.norm(center))  # not edge-on
    on_plane = np.array([*rng.uniform(-500, 500, 2), 0.0])  # C' in world coordinates
    plane = ReferencePlane(rotation=rotation, translation_mm=center - rotation @ on_plane)

    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.12, (20, 3)), axis=0))
    steps = turns.apply([rng.uniform(5, 25), 0, 0]) @ Rotation.random(rng=rng).as_matrix().T
    midline = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    midline += center - midline[rng.integers(5, 15)] + rng.normal(0, 5, 3)  # c beside the midline
    for end in midline[[0, -1]]:
        assume(angle(end, end - center) > 0.02)
        assume(angle(end, end - center) < np.pi - 0.02)
    assume((np.abs(midline[:, :2]) < 0.6 * midline[:, 2:]).all())  # within the lens's sane range
    scale = 10 ** rng.uniform(-4, 2)
    shape = make_shape(midline, center, camera, scale=scale, shift=scale * rng.normal(0, 100, 3))
    return shape, midline, center, Calibration(camera=camera, plane=plane)


@given(exact_scenes())
def test_exact_data_give_the_exact_length_and_place(scene):
    shape, midline, center, calibration = scene
    free = {"max_slant_rad": 2.0, "max_bow_ratio": 1.0, "max_bending_ratio": 100.0}
    fish = localized(make_mesh(shape), calibration, **free)
    assert fish.accepted, fish.reason
    assert fish.length_mm == pytest.approx(arc_length(midline), rel=1e-6)
    np.testing.assert_allclose(
        fish.keypoints_mm, np.stack([midline[0], center, midline[-1]]), rtol=1e-6, atol=1e-3
    )
    np.testing.assert_allclose(fish.midline_mm, midline, rtol=1e-6, atol=1e-3)


@given(exact_scenes())
def test_without_bending_the_length_is_the_chord(scene):
    shape, midline, _, calibration = scene
    fish = localized(make_mesh(shape), calibration, bending=False)
    assert fish.length_mm == pytest.approx(np.linalg.norm(midline[0] - midline[-1]), rel=1e-6)
    assert fish.bending_ratio == pytest.approx(arc_length(midline) / fish.length_mm, rel=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_intersection_is_the_point_nearest_to_both_lines(seed):
    """Slow twin: minimise the sum of squared distances to both lines by the normal equations."""
    rng = np.random.default_rng(seed)
    center, ray = rng.normal([0, 0, 5], 1), rng.normal([0, 0, 1], 0.2)
    direction = rng.uniform(0.5, 4) * ray - center + rng.normal(0, 0.05, 3)  # nearly meets the ray
    assume(angle(ray, direction) > 0.05)
    assume(angle(ray, direction) < np.pi - 0.05)
    beside = [np.eye(3) - np.outer(d, d) / (d @ d) for d in (ray, direction)]
    expected = np.linalg.solve(beside[0] + beside[1], beside[1] @ center)
    assume(expected @ ray > 0)
    assume((expected - center) @ direction > 0)
    np.testing.assert_allclose(intersect(ray, center, direction), expected, rtol=1e-8, atol=1e-8)


def test_the_place_scales_with_the_plane():
    near, far = make_calibration(depth_mm=1000.0), make_calibration(depth_mm=3000.0)
    mesh = straight_fish(near, length_mm=500.0)
    assert localized(mesh, far).length_mm == pytest.approx(3 * 500.0, rel=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_head_along_the_cameras_ray_is_refused(sign):
    """The center is off the axis, the head straight before or behind it: any scale would do."""
    calibration = make_calibration()
    center = 2500.0 * np.array([0.1, -0.05, 1.0])
    midline = np.stack([center * (1 + 0.1 * sign), center + 30.0, center + np.array([200.0, 0, 0])])
    mesh = make_mesh(make_shape(midline, center, calibration.camera))
    fish = localized(mesh, calibration)
    assert (fish.accepted, fish.reason, fish.length_mm) == (False, Reason.SEEN_END_ON, None)
    assert fish.bending_ratio is not None


def test_keypoint_at_the_center_is_refused():
    calibration = make_calibration()
    center = np.array([0.0, 0.0, 2500.0])
    midline = np.stack(
        [center, center + np.array([100.0, 10, 0]), center + np.array([200.0, 0, 0])]
    )
    shape = make_shape(midline, center, calibration.camera)
    fish = localized(make_mesh(shape), calibration)
    assert (fish.reason, fish.length_mm) == (Reason.KEYPOINTS_COINCIDE, None)
    hidden = localized(make_mesh(shape, quality=quality(visible_fraction=0.1)), calibration)
    assert (hidden.reason, hidden.length_mm) == (Reason.MOSTLY_HIDDEN, None)  # the first reason


def test_closed_midline_is_refused():
    calibration = make_calibration()
    center = np.array([0.0, 0.0, 2500.0])
    midline = center + np.array([[100.0, 0, 0], [0, 50, 0], [100.0, 0, 0]])
    fish = localized(make_mesh(make_shape(midline, center, calibration.camera)), calibration)
    assert (fish.reason, fish.length_mm, fish.bending_ratio) == (
        Reason.KEYPOINTS_COINCIDE,
        None,
        None,
    )


@pytest.mark.parametrize(
    ("rotation_rad", "translation_mm"),
    [((0, 0, 0), (0, 0, -2500)), ((np.pi / 2, 0, 0), (0, 300, 0))],
    ids=["behind the camera", "parallel to the center's ray"],
)
def test_plane_out_of_sight_is_refused(rotation_rad, translation_mm):
    mesh, camera = straight_fish(make_calibration()), make_calibration().camera
    plane = ReferencePlane(
        rotation=np.round(Rotation.from_rotvec(rotation_rad).as_matrix()),
        translation_mm=np.array(translation_mm, np.float64),
    )
    fish = localized(mesh, Calibration(camera=camera, plane=plane))
    assert (fish.accepted, fish.reason, fish.length_mm) == (False, Reason.PLANE_BEHIND_CAMERA, None)


@pytest.mark.parametrize("direction", [(-1.0, 0, 0), (-50.0, 0, -1500)])  # of the center, camera
def test_lines_that_meet_on_the_wrong_side_are_refused(direction):
    with pytest.raises(Unlocatable, match=Reason.KEYPOINTS_DISAGREE):
        intersect(np.array([0.1, 0, 1.0]), np.array([0.0, 0, 1000]), np.array(direction))


@pytest.mark.parametrize("field", ["keypoints", "keypoints_px", "midline"])
def test_a_fit_that_is_not_finite_is_refused(field):
    calibration = make_calibration()
    shape = straight_fish(calibration).shape
    values = {name: getattr(shape, name) for name in shape.__slots__}
    values[field] = np.where(np.arange(values[field].size) == 0, np.nan, values[field].ravel())
    values[field] = values[field].reshape(getattr(shape, field).shape)
    fish = localized(make_mesh(FittedShape(**values)), calibration)
    assert (fish.accepted, fish.reason, fish.length_mm) == (False, Reason.POOR_FIT, None)
    assert fish.length_std_mm is None


def quality(**changes):
    facts = {"touches_border": False, "visible_fraction": 1.0, "sharpness": 9.0}
    return CropQuality(**({"mask_area_px": 1e5} | facts | changes))


@pytest.mark.parametrize(
    ("changes", "shape_changes", "reason"),
    [
        ({}, {}, ""),
        ({"touches_border": True}, {}, Reason.TOUCHES_BORDER),
        ({"visible_fraction": 0.69}, {}, Reason.MOSTLY_HIDDEN),
        ({"visible_fraction": np.nan}, {}, Reason.MOSTLY_HIDDEN),
        ({"mask_confidence": 0.35}, {}, Reason.UNSURE_MASK),
        ({"mask_confidence": np.nan}, {}, Reason.UNSURE_MASK),
        ({}, {"iou": 0.84}, Reason.POOR_FIT),
        ({}, {"iou": np.nan}, Reason.POOR_FIT),
        ({}, {"std_ratio": 0.21}, Reason.UNCERTAIN),
        ({"touches_border": True}, {"iou": 0.1}, Reason.TOUCHES_BORDER),
        # Shorter in the picture than it is broad: head and tail are not where the fish ends.
        ({"mask_area_px": 1e7}, {}, Reason.KEYPOINTS_COINCIDE),
    ],
)
def test_gates_name_the_first_reason_and_keep_the_millimetres(changes, shape_changes, reason):
    calibration = make_calibration()
    shape = straight_fish(calibration, **shape_changes).shape
    fish = localized(make_mesh(shape, quality=quality(**changes)), calibration)
    assert (fish.reason, fish.accepted) == (reason, reason == "")
    assert fish.length_mm == pytest.approx(700.0)


@pytest.mark.parametrize(
    ("breadth", "iou", "is_accepted"),
    [(0.3, 0.84, False), (0.11, 0.84, False), (0.06, 0.8, True), (0.06, 0.74, False)],
)
def test_slender_fish_may_overlap_less(breadth, iou, is_accepted):
    """Half a pixel beside the edge of a body 6 pixels broad is an IoU of 0.85."""
    calibration = make_calibration()
    shape = straight_fish(calibration, iou=iou).shape
    head, _, tail = shape.keypoints_px
    area = breadth * float(np.sum((head - tail) ** 2))
    fish = localized(make_mesh(shape, quality=quality(mask_area_px=area)), calibration)
    assert fish.accepted == is_accepted


@pytest.mark.parametrize("offset_px", [0.3, 1.0])
def test_an_edge_off_by_as_many_pixels_is_as_poor_a_fit_of_any_slender_fish(offset_px):
    axis = np.array([[0.0, 0.0], [40.0, 5.0], [100.0, 0.0]])
    length = arc_length(axis)
    found = [
        misfit(breadth / (breadth + offset_px), breadth * length, axis) for breadth in (6.0, 8.0)
    ]
    assert found == pytest.approx([offset_px / (0.1 * length)] * 2, rel=0.15)
    assert misfit(0.8, 0.3 * length**2, axis) == pytest.approx(0.2)  # as it is, of a broad one
    assert np.isnan(misfit(np.nan, 600.0, axis))


@pytest.mark.parametrize("std_ratio", [np.nan, np.inf])
def test_a_fit_without_uncertainty_is_uncertain_and_has_no_std(std_ratio):
    calibration = make_calibration()
    fish = localized(straight_fish(calibration, std_ratio=std_ratio), calibration)
    assert (fish.reason, fish.length_std_mm) == (Reason.UNCERTAIN, None)


def test_border_gate_can_be_switched_off():
    calibration = make_calibration()
    mesh = make_mesh(straight_fish(calibration).shape, quality=quality(touches_border=True))
    assert localized(mesh, calibration, refuse_border=False).accepted


@pytest.mark.parametrize("tilt_rad", [0.0, 0.6, -0.9])
def test_std_of_the_plane_is_what_moving_the_plane_does(tilt_rad):
    """Move the true plane along its normal by d: the length changes by the ratio the std states.

    It is the same in all frames of a fish, so it is no part of a frame's own std.
    """
    calibration, d = make_calibration(tilt_rad=tilt_rad), 1e-3
    normal = calibration.plane.rotation[:, 2]
    moved = ReferencePlane(
        rotation=calibration.plane.rotation,
        translation_mm=calibration.plane.translation_mm + d * normal,
    )
    mesh = straight_fish(calibration, std_ratio=0.0)
    fish = localized(mesh, calibration, plane_std_mm=d, slant_std_rad=0.0, misfit_std=0.0)
    change = localized(mesh, Calibration(camera=calibration.camera, plane=moved)).length_mm - 700.0
    assert 700.0 * fish.shared_std_ratio == pytest.approx(abs(change), rel=1e-4)
    assert fish.length_std_mm == pytest.approx(0.0, abs=1e-6)


def test_shape_and_plane_are_shared_by_all_frames_and_independent():
    calibration = make_calibration(depth_mm=2000.0)
    mesh = straight_fish(calibration)
    unknown = replace(mesh, shape=replace(mesh.shape, shape_std_ratio=0.03))
    shared = [localized(fit, calibration, plane_std_mm=80.0) for fit in (mesh, unknown)]
    assert [fish.shared_std_ratio for fish in shared] == pytest.approx([0.04, 0.05])


@pytest.mark.parametrize("slant_rad", [0.0, 0.3, -0.6, 1.1])
def test_slanting_views_are_less_certain_and_refused_in_the_end(slant_rad):
    """A turn by a small d changes the length behind a seen extent by tan(slant) d."""
    calibration = make_calibration(depth_mm=50_000.0)  # no perspective along the body
    direction = (np.cos(slant_rad), 0.0, np.sin(slant_rad))
    mesh = straight_fish(calibration, direction=direction, std_ratio=0.0)
    fish = localized(mesh, calibration, plane_std_mm=1e-9, slant_std_rad=0.1, misfit_std=0)
    d = 1e-5
    slope = (np.cos(slant_rad) / np.cos(abs(slant_rad) + d) - 1) / d
    assert fish.length_std_mm == pytest.approx(700 * 0.1 * slope, rel=1e-3, abs=0.1)
    assert fish.reason == ("turned away" if slant_rad > 1.0 else "")


def test_a_bent_fish_is_less_certain_by_a_part_of_what_bending_adds():
    calibration = make_calibration(depth_mm=2000.0)
    mesh = bent_fish(calibration, std_ratio=0.01)
    options = {"plane_std_mm": 1e-9, "slant_std_rad": 0.0, "misfit_std": 0, "bending_std": 0.2}
    bent = localized(mesh, calibration, **options)
    added = 1 - np.linalg.norm(bent.keypoints_mm[0] - bent.keypoints_mm[2]) / bent.length_mm
    assert added > 0.05
    assert bent.length_std_mm == pytest.approx(bent.length_mm * np.hypot(0.01, 0.2 * added))
    chord = localized(mesh, calibration, bending=False, **options)
    assert chord.length_std_mm == pytest.approx(0.01 * chord.length_mm)


@pytest.mark.parametrize(("iou", "std_ratio"), [(1.0, 0.0), (0.95, 0.015), (0.9, 0.12)])
def test_a_poor_fit_is_less_certain(iou, std_ratio):
    calibration = make_calibration(depth_mm=50_000.0)
    mesh = straight_fish(calibration, std_ratio=0.0, iou=iou)
    fish = localized(mesh, calibration, plane_std_mm=1e-9, slant_std_rad=0.0, misfit_std=0.12)
    assert fish.length_std_mm == pytest.approx(700 * std_ratio, abs=0.1)


@pytest.mark.parametrize("bend_rad", [0.6, 1.8, np.pi])
def test_the_bow_of_an_arc_is_its_sagitta_where_it_bends_in_depth(bend_rad):
    angles = np.linspace(-bend_rad / 2, bend_rad / 2, 200)
    arc = np.stack([np.sin(angles), np.zeros(200), np.cos(angles)], axis=1) / bend_rad
    sagitta = (1 - np.cos(bend_rad / 2)) / bend_rad
    assert bow_ratio(arc, np.array([0.0, 0.0, 2.0])) == pytest.approx(sagitta, rel=1e-3)
    assert bow_ratio(700 * arc, np.array([0.0, 1.0, 0.0])) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("bend_rad", "is_fine"), [(1.8, True), (2.9, True), (5.0, False)])
def test_a_fish_that_bends_further_than_fish_can_is_refused(bend_rad, is_fine):
    fish = localized(bent_fish(make_calibration(), bend_rad=bend_rad), make_calibration())
    assert fish.accepted == is_fine
    assert fish.length_mm == pytest.approx(700.0, rel=0.01)  # for whoever looks at it
    assert is_fine or fish.reason == Reason.BENT_TOO_FAR


def test_without_calibration_pixels_and_bending_remain():
    mesh = straight_fish(make_calibration())
    (fish,) = Localize(LocalizeSettings(), calibration=None).step(mesh)
    assert (fish.accepted, fish.reason) == (False, Reason.NO_CALIBRATION)
    assert fish.length_mm is fish.length_std_mm is fish.keypoints_mm is fish.midline_mm is None
    assert fish.bending_ratio == pytest.approx(1.0)
    np.testing.assert_array_equal(fish.keypoints_px, mesh.shape.keypoints_px)


def test_refusal_of_the_fit_is_passed_on():
    node = Localize(LocalizeSettings(), calibration=make_calibration())
    (fish,) = node.step(make_mesh(None, refusal="no mask"))
    assert (fish.accepted, fish.reason, fish.iou) == (False, "no mask", None)
    assert (fish.frame_index, fish.timestamp_ns, fish.track_id) == (7, 280_000_000, 3)
    assert list(node.close()) == []


def test_a_mask_that_is_less_sure_or_longer_in_a_longer_box_gives_a_wider_length():
    calibration = make_calibration()
    stds = []
    for confidence, doubt in ((None, None), (0.95, None), (0.7, None), (0.7, 0.0), (0.7, 0.1)):
        quality = replace(GOOD, mask_confidence=confidence, length_doubt=doubt)
        mesh = replace(straight_fish(calibration), quality=quality)
        stds.append(localized(mesh, calibration).shared_std_ratio)
    given, sure, unsure, looked_again, doubted = stds
    assert given < sure < unsure == looked_again < doubted


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 0.3))
def test_the_likelier_a_mask_lacks_an_end_the_wider_is_its_length(missing, confidence, doubt):
    quality = replace(GOOD, mask_confidence=confidence, length_doubt=doubt)
    ratios = [mask_std_ratio(replace(quality, missing_end=m)) for m in (0.0, missing, 1.0)]
    assert ratios == sorted(ratios)
    assert ratios[2] >= 0.12
    given = replace(quality, mask_confidence=None, missing_end=1.0)
    assert mask_std_ratio(given) == 0


@pytest.mark.parametrize(
    ("missing", "reason"), [(None, None), (0.97, None), (0.99, Reason.END_NOT_SEEN)]
)
def test_a_mask_that_seems_to_lack_an_end_is_refused(missing, reason):
    quality = replace(GOOD, missing_end=missing)
    shape = straight_fish(make_calibration()).shape
    assert quality_refusal(shape, quality, LocalizeSettings()) == reason


def lying_fish(calibration, *, length_mm, ends, half_thickness=0.05):
    """A straight fish on the plane: heights of head and tail over half its thickness, `ends`."""
    plane = calibration.plane
    toward_camera = np.sign(-plane.rotation[:, 2] @ plane.translation_mm)
    heights_mm = np.array([ends[0], 1.0, ends[1]]) * half_thickness * length_mm
    along_mm = np.array([-0.5, 0.0, 0.5]) * length_mm
    world_mm = np.column_stack([along_mm, np.full(3, 0.1 * length_mm), toward_camera * heights_mm])
    points_mm = world_mm @ plane.rotation.T + plane.translation_mm
    shape = make_shape(points_mm[[0, 2]], points_mm[1], calibration.camera)
    return make_mesh(replace(shape, height_ratio=half_thickness))


@pytest.mark.parametrize("distance_mm", [300.0, 2500.0])
@pytest.mark.parametrize("tilt_rad", [0.0, 0.3])
def test_ends_of_a_lying_fish_are_as_low_as_such_bodies_rest(distance_mm: float, tilt_rad: float):
    calibration = make_calibration(tilt_rad=tilt_rad, depth_mm=distance_mm)
    length_mm = 0.4 * distance_mm
    mesh = lying_fish(calibration, length_mm=length_mm, ends=(0.5, 0.25))
    fish = localized(mesh, calibration, rests_on_plane=True)
    assert fish.length_mm == pytest.approx(length_mm, rel=2e-3)  # of the chord's slope


@pytest.mark.parametrize("ends", [(1.0, 1.0), (0.3, 0.0)])
def test_stiff_and_limp_fish_are_within_the_std_of_a_lying_fish(ends: tuple[float, float]):
    calibration = make_calibration(depth_mm=400.0)
    mesh = lying_fish(calibration, length_mm=250.0, ends=ends)
    fish = localized(mesh, calibration, rests_on_plane=True, plane_std_mm=1e-6)
    assert fish.length_mm is not None
    assert fish.shared_std_ratio is not None
    assert abs(np.log(fish.length_mm / 250.0)) < 2.6 * fish.shared_std_ratio
    far = make_calibration(depth_mm=4000.0)
    mesh = lying_fish(far, length_mm=250.0, ends=ends)
    from_far = localized(mesh, far, rests_on_plane=True, plane_std_mm=1e-6)
    assert from_far.shared_std_ratio == pytest.approx(fish.shared_std_ratio / 10, rel=0.1)
