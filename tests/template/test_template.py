"""The canonical form of a template, and its simplification."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh.proximity import closest_point_naive

from stream_dmr.template.template import canonical_template, simplified
from stream_dmr.template.template_file import load_template
from tests.support.shapes import POINTS, fish_mesh, fish_template, seeds
from tests.support.template_files import body_of, write_fish


class TestCanonicalForm:
    @staticmethod
    def assert_same_body(template, expected):
        """Equal but for a half turn about x, and for the order of vertices."""
        half_turn = np.array([1.0, -1.0, -1.0])
        sign = min(
            (np.ones(3), half_turn),
            key=lambda s: np.abs(template.joints * s - expected.joints).max(),
        )
        for name in ("keypoints", "joints", "midline"):
            np.testing.assert_allclose(
                getattr(template, name) * sign, getattr(expected, name), atol=1e-9, err_msg=name
            )
        gap, twin = cKDTree(expected.rest_vertices).query(template.rest_vertices * sign)
        assert gap.max() < 1e-9
        assert sorted(twin) == list(range(len(expected.rest_vertices)))
        # A half turn keeps the winding; each face starts at its smallest vertex to compare.
        assert canonical_faces(twin[template.faces]) == canonical_faces(expected.faces)

    @given(
        seed=seeds,
        scale=st.floats(1e-2, 1e4),
        is_inside_out=st.booleans(),
        is_joint_order_reversed=st.booleans(),
    )
    def test_does_not_depend_on_unit_place_orientation_or_winding(
        self, tmp_path_factory, seed, scale, is_inside_out, is_joint_order_reversed
    ):
        rng = np.random.default_rng(seed)
        rotation = Rotation.random(rng=rng)
        shift = rng.normal(size=3)

        def move(points):
            return scale * (rotation.apply(points) + shift)

        mesh = fish_mesh()
        mesh.vertices = move(mesh.vertices)
        if is_inside_out:
            mesh.invert()
        joints = POINTS["joints"][::-1] if is_joint_order_reversed else POINTS["joints"]
        points = {"keypoints": move(POINTS["keypoints"]), "joints": move(joints)}
        path = write_fish(tmp_path_factory.mktemp("moved"), mesh=mesh, points=points)
        self.assert_same_body(
            load_template(path), canonical_template(fish_mesh(), POINTS, name="expected")
        )

    def test_is_right_handed_so_that_no_body_becomes_its_mirror_image(self):
        template = canonical_template(fish_mesh(), POINTS, name="fish")
        assert body_of(template).volume > 0


class TestSimplified:
    def test_is_the_same_body_of_fewer_faces(self):
        template = fish_template(subdivisions=3)  # 1,280 faces
        template.rest_vertices.flags.writeable = False  # as one that was read from a recording
        fewer = simplified(template, max_faces=400)
        assert len(fewer.faces) <= 400
        before, after = body_of(template), body_of(fewer)
        assert after.is_watertight
        assert after.volume == pytest.approx(before.volume, rel=0.02)
        _, gap, _ = closest_point_naive(before, after.vertices)
        assert gap.max() < 0.005, "body lengths: vertices stay on the surface"
        np.testing.assert_allclose(after.bounds, before.bounds, atol=0.005)
        for field in ("keypoints", "joints", "midline"):
            np.testing.assert_array_equal(getattr(fewer, field), getattr(template, field))

    def test_leaves_a_coarse_body_as_it_is(self):
        template = fish_template(subdivisions=2)
        assert simplified(template, max_faces=len(template.faces)) is template


def canonical_faces(faces):
    return {tuple(np.roll(face, -np.argmin(face)).tolist()) for face in faces}
