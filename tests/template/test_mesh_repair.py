"""Meshes that are not one closed surface: what is made of them, and what is refused."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.errors import TemplateError
from stream_dmr.template.mesh_repair import repair_mesh
from tests.support.shapes import fish_mesh

FISH = fish_mesh(subdivisions=3)


def without(mesh: trimesh.Trimesh, num_faces: int) -> trimesh.Trimesh:
    """Without the faces nearest to the first one: one hole."""
    near = np.linalg.norm(mesh.triangles_center - mesh.triangles_center[0], axis=1).argsort()
    return trimesh.Trimesh(mesh.vertices, mesh.faces[near[num_faces:]], process=False)


def sheet(*, height: float) -> trimesh.Trimesh:
    """A fin without thickness on the back of the fish."""
    corners = [[-0.1, 0.1, 0], [0.1, 0.1, 0], [0.1, 0.1 + height, 0], [-0.1, 0.1 + height, 0]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def assert_closed(mesh: trimesh.Trimesh) -> None:
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0


def test_a_closed_mesh_is_left_as_it_is():
    repaired = repair_mesh(FISH.copy(), name="fish")
    assert repaired.changes == ()
    np.testing.assert_array_equal(repaired.mesh.vertices, FISH.vertices)
    np.testing.assert_array_equal(repaired.mesh.faces, FISH.faces)


@settings(max_examples=15, deadline=None)
@given(num_faces=st.integers(1, 60), seed=st.integers(0, 99), num_flipped=st.integers(0, 300))
def test_a_hole_and_flipped_faces_cost_hardly_any_volume(
    num_faces: int, seed: int, num_flipped: int
):
    mesh = without(FISH, num_faces)
    faces = np.array(mesh.faces)
    flipped = np.random.default_rng(seed).permutation(len(faces))[:num_flipped]
    faces[flipped] = faces[flipped, ::-1]
    repaired = repair_mesh(trimesh.Trimesh(mesh.vertices, faces, process=False), name="fish")
    assert_closed(repaired.mesh)
    assert repaired.mesh.volume == pytest.approx(FISH.volume, rel=0.1)
    assert repaired.changes == ("open parts closed by filling their holes: 1",)


def test_faces_turned_inwards_are_turned_outwards():
    faces = np.array(FISH.faces)
    faces[::3] = faces[::3, ::-1]
    repaired = repair_mesh(trimesh.Trimesh(FISH.vertices, faces, process=False), name="fish")
    assert_closed(repaired.mesh)
    assert repaired.mesh.volume == pytest.approx(FISH.volume, rel=1e-6)
    assert repaired.changes == ("faces turned outwards",)


def test_overlapping_closed_parts_become_one_surface():
    eye = trimesh.creation.icosphere(radius=0.03)
    eye.apply_translation([-0.35, 0.0, 0.05])
    repaired = repair_mesh(trimesh.util.concatenate([FISH, without(eye, 1)]), name="fish")
    assert_closed(repaired.mesh)
    assert repaired.mesh.body_count == 1
    assert FISH.volume < repaired.mesh.volume < FISH.volume + eye.volume
    assert "closed parts united with the largest: 1" in repaired.changes


def test_a_fin_without_thickness_gets_one():
    repaired = repair_mesh(trimesh.util.concatenate([FISH, sheet(height=0.15)]), name="fish")
    assert_closed(repaired.mesh)
    assert repaired.mesh.bounds[1, 1] == pytest.approx(0.25, abs=1e-6)
    assert repaired.changes == ("sheets given a thickness: 1",)


def test_small_open_parts_and_loose_ones_are_removed():
    tooth = sheet(height=0.01)
    crumb = trimesh.creation.icosphere(radius=0.03)
    crumb.apply_translation([2.0, 0.0, 0.0])
    repaired = repair_mesh(trimesh.util.concatenate([FISH, tooth, crumb]), name="fish")
    assert_closed(repaired.mesh)
    assert repaired.mesh.volume == pytest.approx(FISH.volume, rel=1e-6)
    assert repaired.changes[:2] == ("small open parts removed: 1", "loose parts removed: 1")


def test_double_and_degenerate_faces_are_removed():
    faces = np.vstack([FISH.faces, FISH.faces[:5], [[0, 0, 1]]])
    repaired = repair_mesh(trimesh.Trimesh(FISH.vertices, faces, process=False), name="fish")
    assert_closed(repaired.mesh)
    assert repaired.changes == ("degenerate or double faces removed: 6",)


def test_sheets_alone_are_refused():
    with pytest.raises(TemplateError, match="template fin: expected a mesh that can be closed"):
        repair_mesh(sheet(height=0.15), name="fin")


def test_two_fish_are_refused():
    other = FISH.copy()
    other.apply_translation([0.0, 3.0, 0.0])
    for also in ([sheet(height=0.15)], []):
        both = trimesh.util.concatenate([FISH, other, *also])
        with pytest.raises(TemplateError, match="expected one body, got 2 that do not touch"):
            repair_mesh(both, name="pair")
