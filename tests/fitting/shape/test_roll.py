"""Roll: known turns come back, slopes are finite differences, and what roll hides is found."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stream_dmr.fitting.body import ROOT_ROTATION, rest_vector
from stream_dmr.fitting.shape.stock import rolled_as_seen, unrolled
from stream_dmr.fitting.solver.problem import roll_and_slope

RAY = np.array([0.1, -0.05, 1.0])
angles = st.floats(-1.2, 1.2)
rotations = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(random_state=seed))


def pose_of(rotation):
    pose = rest_vector(2)
    pose[ROOT_ROTATION] = rotation.as_rotvec()
    return pose


def roll_rad(pose, anchor):
    return roll_and_slope(pose, anchor)[0]


@given(in_plane=st.floats(-3.1, 3.1), roll=angles)
def test_a_turn_about_the_own_axis_is_the_roll(in_plane, roll):
    """Also for a fish that shows its other side, and one that swims the other way."""
    toward = np.array([0.0, 0.0, 1.0])
    flat = Rotation.from_euler("z", in_plane)
    for side in (0.0, np.pi):
        rotation = flat * Rotation.from_euler("x", side + roll)
        assert roll_rad(pose_of(rotation), toward) == pytest.approx(-roll, abs=1e-9)


@given(rotation=rotations)
def test_an_unrolled_fish_has_its_axis_and_no_roll(rotation):
    pose = unrolled(pose_of(rotation), RAY)
    assert roll_rad(pose, RAY) == pytest.approx(0.0, abs=1e-7)
    turned = Rotation.from_rotvec(pose[ROOT_ROTATION])
    np.testing.assert_allclose(turned.apply([1, 0, 0]), rotation.apply([1, 0, 0]), atol=1e-9)


@given(rotation=rotations)
def test_the_slope_is_a_finite_difference(rotation):
    pose, step = pose_of(rotation), 1e-6
    _, slope = roll_and_slope(pose, RAY)
    for p in range(3):
        ahead, behind = pose.copy(), pose.copy()
        ahead[p] += step
        behind[p] -= step
        gap = roll_rad(ahead, RAY) - roll_rad(behind, RAY)
        gap = (gap + np.pi / 2) % np.pi - np.pi / 2  # beyond a right angle the other side is seen
        assert gap / (2 * step) == pytest.approx(slope[p], rel=1e-3, abs=1e-3)


@given(rotation=rotations, roll=st.floats(0.0, 1.5), thin=st.floats(0.2, 0.9))
def test_a_pose_is_rolled_until_a_breadth_is_seen(rotation, roll, thin):
    flat = unrolled(pose_of(rotation), RAY)
    seen = float(np.log(np.hypot(np.cos(roll), thin * np.sin(roll))))
    rolled = rolled_as_seen(flat, seen, thin)
    assert abs(roll_rad(rolled, RAY)) == pytest.approx(roll, abs=1e-6)


def test_no_roll_shows_more_than_the_breadth_or_less_than_the_thickness():
    flat = unrolled(pose_of(Rotation.identity()), RAY)
    np.testing.assert_allclose(rolled_as_seen(flat, 0.3, 0.5), flat, atol=1e-9)
    edge_on = rolled_as_seen(flat, -5.0, 0.5)
    assert abs(roll_rad(edge_on, RAY)) == pytest.approx(np.pi / 2, abs=1e-6)
