"""The closed surface through rings."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.template.from_masks import (
    NUM_RINGS,
    NUM_SECTORS,
    ring_angles,
    ring_mesh,
    ring_places,
)


def spindle(*, breadth: float, thickness: float) -> np.ndarray:
    x, angle = ring_places(), ring_angles()
    radius = np.sqrt(x * (1 - x))[:, None]
    y, z = breadth * radius * np.cos(angle), thickness * radius * np.sin(angle)
    return np.stack([np.broadcast_to(x[:, None], y.shape), y, z], axis=-1)


@given(breadth=st.floats(0.05, 1.0), thickness=st.floats(0.05, 1.0))
def test_it_is_closed_faces_outwards_and_has_the_volume_of_an_ellipsoid(breadth, thickness):
    mesh = ring_mesh(spindle(breadth=breadth, thickness=thickness))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    ellipsoid = np.pi / 6 * breadth * thickness
    assert 0.9 * ellipsoid < mesh.volume < ellipsoid


def test_vertices_are_the_rings_then_the_two_ends():
    rings = spindle(breadth=0.3, thickness=0.1)
    vertices = ring_mesh(rings).vertices
    np.testing.assert_array_equal(vertices[:-2], rings.reshape(-1, 3))
    np.testing.assert_array_equal(vertices[-2:], [[0, 0, 0], [1, 0, 0]])


def test_the_direction_of_the_rings_does_not_matter():
    rings = spindle(breadth=0.3, thickness=0.1)
    mirrored = ring_mesh(rings[:, ::-1])
    assert mirrored.volume > 0
    np.testing.assert_allclose(mirrored.volume, ring_mesh(rings).volume)


def test_places_are_denser_at_both_ends_and_angles_go_round_once():
    places, angles = ring_places(), ring_angles()
    steps = np.diff(places)
    assert len(places) == NUM_RINGS
    assert (steps > 0).all()
    assert steps[[0, -1]].max() < steps[NUM_RINGS // 2] / 3
    np.testing.assert_allclose(places + places[::-1], 1.0)
    np.testing.assert_allclose(np.diff(angles), 2 * np.pi / NUM_SECTORS)
