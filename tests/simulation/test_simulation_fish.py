"""The bodies of the simulation: exact lengths, bends, outlines and silhouettes."""

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.errors import UserError
from stream_dmr.geometry import arc_length, bending_ratio
from stream_dmr.simulation.rail_scene import PRESETS, draw_calibration, make_scene
from stream_dmr.simulation.render import draw_fish_patch, frame_window
from stream_dmr.simulation.simulated_fish import (
    CENTER_ARC,
    HALIBUT,
    NUM_STEPS,
    SPECIES,
    HangingPose,
    bend_center_line,
    draw_body,
    draw_fish,
    find_species,
    keypoints,
    pose_fish,
    straight_body,
    total_bend_rad,
)
from tests.support.simulated_view import draw_mask, draw_view

SEEDS = st.integers(0, 2**32 - 1)
PRESET_NAMES = st.sampled_from(sorted(PRESETS))


def random_bends(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, 2.0, (3, 3))


def straight_pose() -> HangingPose:
    return HangingPose(
        bends=np.zeros((3, 3)),
        yaw_rad=0.3,
        sway_rad=0.2,
        tilt_rad=-0.1,
        center_world_mm=np.array([100.0, -50.0, 7.0]),
    )


@given(seed=SEEDS, length_mm=st.floats(100.0, 3000.0))
def test_centre_line_is_as_long_as_the_fish_however_it_is_bent(seed, length_mm):
    spine = bend_center_line(random_bends(seed), length_mm=length_mm)
    assert arc_length(spine.points) == pytest.approx(length_mm, rel=1e-9)


@given(seed=SEEDS)
def test_body_frames_stay_rotations_along_the_tangent(seed):
    spine = bend_center_line(random_bends(seed), length_mm=1.0)
    np.testing.assert_allclose(
        np.swapaxes(spine.frames, 1, 2) @ spine.frames,
        np.broadcast_to(np.eye(3), spine.frames.shape),
        atol=1e-12,
    )
    chords = np.diff(spine.points, axis=0) * NUM_STEPS
    middles = (spine.frames[:-1, :, 0] + spine.frames[1:, :, 0]) / 2
    np.testing.assert_allclose(chords, middles, atol=5e-3)


@given(angle_deg=st.floats(1.0, 170.0))
def test_a_bend_in_one_plane_turns_the_tail_by_the_total_bend(angle_deg):
    bends = np.zeros((3, 1))
    bends[1, 0] = np.radians(angle_deg) * np.pi / 2  # sin(pi s) integrates to 2 / pi
    spine = bend_center_line(bends, length_mm=700.0)
    turned = np.degrees(np.arccos(spine.frames[0, :, 0] @ spine.frames[-1, :, 0]))
    assert np.degrees(total_bend_rad(bends)) == pytest.approx(angle_deg, rel=1e-4)
    assert turned == pytest.approx(angle_deg, rel=1e-4)


def test_twist_alone_leaves_the_centre_line_straight():
    bends = np.zeros((3, 2))
    bends[0] = [1.0, -0.5]
    spine = bend_center_line(bends, length_mm=700.0)
    assert bending_ratio(spine.points) == pytest.approx(1.0, abs=1e-12)
    assert total_bend_rad(bends) == 0.0


def test_a_straight_fish_has_bending_ratio_one():
    rng = np.random.default_rng(1)
    posed = pose_fish(
        draw_fish(rng, track_id=1), straight_pose(), calibration=draw_calibration(rng)
    )
    assert posed.bending_ratio == pytest.approx(1.0, abs=1e-12)
    head, _, tail = posed.keypoints
    assert np.linalg.norm(tail - head) == pytest.approx(posed.fish.length_mm, rel=1e-12)


def test_the_center_keypoint_lies_where_the_pose_puts_it_on_the_plane():
    rng = np.random.default_rng(2)
    calibration = draw_calibration(rng)
    pose = straight_pose()
    posed = pose_fish(draw_fish(rng, track_id=1), pose, calibration=calibration)
    plane = calibration.plane
    in_world = plane.rotation.T @ (posed.keypoints[1] - plane.translation_mm)
    np.testing.assert_allclose(in_world, pose.center_world_mm, atol=1e-9)


@given(seed=SEEDS, preset=PRESET_NAMES)
def test_keypoints_lie_on_the_midline_at_their_arcs(seed, preset):
    posed = draw_view(preset=preset, seed=seed).posed
    head, center, tail = posed.keypoints
    assert posed.arc_mm == pytest.approx(posed.fish.length_mm, rel=1e-9)
    assert 500.0 <= posed.fish.length_mm <= 1000.0
    np.testing.assert_array_equal(head, posed.midline[0])
    np.testing.assert_allclose(tail, posed.midline[-1], atol=1e-9)
    np.testing.assert_allclose(center, posed.midline[round(CENTER_ARC * NUM_STEPS)], atol=1e-9)


@given(seed=SEEDS, preset=PRESET_NAMES)
@settings(max_examples=10, deadline=None)
def test_bends_and_distance_from_the_plane_stay_within_the_preset(seed, preset):
    scene = make_scene(num_fish=3, num_frames=60, preset=preset, seed=seed)
    limit = PRESETS[preset].max_bend_deg
    for visit in scene.visits:
        largest = max(np.degrees(total_bend_rad(pose.bends)) for pose in visit.poses)
        assert 0.7 * limit * (1 - 1e-9) <= largest <= limit
        assert all(abs(pose.center_world_mm[2]) <= 25.0 for pose in visit.poses)


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_bodies_are_closed_and_keep_their_volume_when_bent(seed):
    posed = draw_view(preset="severe", seed=seed).posed
    straight = trimesh.Trimesh(posed.fish.mesh.points, posed.faces, process=False)
    bent = trimesh.Trimesh(posed.vertices, posed.faces, process=False)
    assert straight.is_watertight
    assert straight.is_winding_consistent
    assert straight.volume > 0
    # The centre line passes through the middle of every section (Pappus).
    assert bent.volume == pytest.approx(straight.volume * posed.fish.length_mm**3, rel=0.01)


def test_mean_body_has_the_proportions_of_a_halibut():
    points = straight_body(HALIBUT).points
    breadth, thickness = np.ptp(points[:, 1:], axis=0)
    assert breadth == pytest.approx(0.38, rel=1e-3)
    assert thickness == pytest.approx(0.10, rel=1e-2)
    peduncle = HALIBUT.half_width_at(np.linspace(0.8, 0.95)).min()
    tail = HALIBUT.half_width_at(np.array([1.0]))[0]
    assert tail > 2 * peduncle
    fork, lobes = HALIBUT.surface(np.array([1.0, 1.0]), np.array([np.pi / 2, 0.0]))[:, 0]
    assert fork == 1.0 < lobes


def test_template_keypoints_touch_the_mean_mesh():
    mesh = straight_body(HALIBUT)
    surface = trimesh.Trimesh(mesh.points, mesh.faces, process=False)
    low, high = surface.bounds
    distance = np.abs(trimesh.proximity.closest_point_naive(surface, keypoints()[[0, 2]])[1])
    assert distance.max() < 1e-9  # head and tail are on the skin
    assert ((keypoints() >= low) & (keypoints() <= high)).all()


def test_individuals_vary_about_the_mean_as_stated():
    bodies = [draw_body(np.random.default_rng(seed)) for seed in range(400)]
    widths = np.array([body.half_width for body in bodies]) / HALIBUT.half_width
    thicknesses = np.array([body.half_thickness for body in bodies]) / HALIBUT.half_thickness
    assert widths.mean() == pytest.approx(1.0, abs=0.01)
    assert 0.03 < widths.std() < 0.06
    assert thicknesses.mean() == pytest.approx(1.0, abs=0.02)
    assert 0.07 < thicknesses.std() < 0.12


def naive_mask(pixels: np.ndarray, faces: np.ndarray, width: int, height: int) -> np.ndarray:
    """Slow obvious twin of the rasterizer: each pixel centre against each triangle's sides."""
    mask = np.zeros((height, width), bool)
    xs, ys = np.meshgrid(np.arange(width), np.arange(height))
    for triangle in pixels[faces]:
        sides = []
        for start, end in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
            edge = end - start
            sides.append(edge[0] * (ys - start[1]) - edge[1] * (xs - start[0]))
        sides = np.array(sides)
        mask |= (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
    return mask


@given(seed=SEEDS)
@settings(max_examples=3, deadline=None)
def test_mask_equals_its_slow_twin(seed):
    view = draw_view(preset="severe", seed=seed)
    mask = draw_mask(view.posed.vertices, view.posed.faces, camera=view.calibration.camera)
    rows, columns = np.nonzero(mask)
    low = np.array([columns.min() - 3, rows.min() - 3])
    width, height = columns.max() + 4 - low[0], rows.max() + 4 - low[1]
    twin = naive_mask(view.vertices_px - low, view.posed.faces, int(width), int(height))
    cut = mask[low[1] : low[1] + height, low[0] : low[0] + width]
    assert (cut != twin).sum() <= 2  # centres exactly on a side are the rasterizer's to choose


@given(seed=SEEDS, preset=PRESET_NAMES)
@settings(max_examples=10, deadline=None)
def test_true_keypoints_lie_in_or_at_the_mask(seed, preset):
    view = draw_view(preset=preset, seed=seed)
    camera = view.calibration.camera
    mask = draw_mask(view.posed.vertices, view.posed.faces, camera=camera)
    distance = cv2.distanceTransform(1 - mask.astype(np.uint8), cv2.DIST_L2, 5)
    columns, rows = np.round(camera.project(view.posed.keypoints)).astype(int).T
    assert (distance[rows, columns] <= [2.0, 0.0, 2.0]).all()


@given(seed=SEEDS)
@settings(max_examples=10, deadline=None)
def test_the_drawn_patch_has_the_exact_mask(seed):
    view = draw_view(preset="realistic", seed=seed)
    camera = view.calibration.camera
    mask = draw_mask(view.posed.vertices, view.posed.faces, camera=camera)
    patch = draw_fish_patch(view.posed, camera=camera, seed=seed)
    rows, columns, inside = frame_window(patch, camera.width, camera.height)
    assert patch.mask.sum() == mask.sum()
    assert (mask[rows, columns] != patch.mask[inside]).sum() <= 1  # shifted by whole pixels
    assert (patch.colour[~patch.mask] == 0).all()


def test_a_broad_straight_fish_covers_its_outline_in_pixels():
    rng = np.random.default_rng(5)
    calibration = draw_calibration(rng)
    fish = draw_fish(rng, track_id=1)
    pose = HangingPose(
        bends=np.zeros((3, 3)),
        yaw_rad=0.0,
        sway_rad=0.0,
        tilt_rad=0.0,
        center_world_mm=np.zeros(3),
    )
    posed = pose_fish(fish, pose, calibration=calibration)
    mask = draw_mask(posed.vertices, posed.faces, camera=calibration.camera)
    s = np.linspace(0.0, 1.0, 2001)
    area_mm2 = 2 * np.trapezoid(fish.body.half_width_at(s), s) * fish.length_mm**2
    plane = calibration.plane
    facing = plane.rotation[2, 2]  # the plane is tilted away from the line of sight by little
    scale = calibration.camera.K[0, 0] / plane.translation_mm[2]
    assert mask.sum() == pytest.approx(area_mm2 * scale**2 * facing, rel=0.05)


def test_species_take_turns_and_keep_their_proportions():
    scene = make_scene(
        num_fish=6, num_frames=30, preset="clean", seed=3, species=find_species("conger,perch")
    )
    breadths = [visit.fish.body.half_width for visit in scene.visits]
    for breadth, name in zip(breadths, 3 * ("conger", "perch"), strict=True):
        assert breadth == pytest.approx(SPECIES[name].half_width, rel=0.11)


def test_an_unknown_species_is_refused_with_those_that_exist():
    with pytest.raises(UserError, match=r"--species: expected any of halibut.*, got 'whale'"):
        find_species("perch,whale")
