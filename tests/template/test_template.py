import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh.proximity import closest_point_naive

from stream_dmr.errors import TemplateError
from stream_dmr.geometry import arc_length
from stream_dmr.template.make_bundled import body_forms, body_mesh, template_toml
from stream_dmr.template.template import (
    BUNDLED,
    bundled_names,
    load_template,
    make_template,
    simplified,
)
from tests.support.shapes import POINTS, fish_mesh, fish_template, seeds


def write_fish(folder, *, mesh=None, points=POINTS, name="fish.obj"):
    """An OBJ with every digit, and the TOML beside it."""
    mesh = mesh or fish_mesh()
    lines = ["v {!r} {!r} {!r}".format(*map(float, v)) for v in mesh.vertices]
    lines += ["f {} {} {}".format(*(face + 1)) for face in mesh.faces]
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".toml").write_text(toml(points))
    return path


def toml(points):
    ends = zip(("head", "center", "tail"), points["keypoints"].tolist(), strict=True)
    return f"joints = {points['joints'].tolist()}\n[keypoints]\n" + "\n".join(
        f"{key} = {point}" for key, point in ends
    )


def body_of(template):
    return trimesh.Trimesh(template.rest_vertices, template.faces, process=False)


@pytest.mark.parametrize("name", bundled_names())
class TestBundled:
    def test_is_a_closed_body_of_500_to_700_vertices(self, name):
        template = load_template(name)
        body = body_of(template)
        assert 500 <= len(template.rest_vertices) <= 700
        assert body.is_watertight
        assert body.is_winding_consistent
        assert body.volume > 0, "faces run counter-clockwise seen from outside"

    def test_is_one_body_length_from_head_to_tail_along_x(self, name):
        template = load_template(name)
        head, center, tail = template.keypoints
        assert arc_length(template.midline) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(tail - head, [1, 0, 0], atol=1e-12)
        np.testing.assert_array_equal(center, [0, 0, 0])
        np.testing.assert_allclose(template.midline[[0, -1]], [head, tail], atol=1e-15)
        steps = np.linalg.norm(np.diff(template.midline, axis=0), axis=1)
        np.testing.assert_allclose(steps, steps[0])

    def test_is_broader_than_thick(self, name):
        _, broad, thin = np.ptp(load_template(name).rest_vertices, axis=0)
        assert thin < broad < 0.5

    def test_is_what_its_script_makes(self, name, tmp_path):
        form = body_forms()[name]
        body_mesh(form).export(tmp_path / "again.ply")
        again = trimesh.load_mesh(tmp_path / "again.ply", process=False)
        kept = trimesh.load_mesh(BUNDLED / f"{name}.ply", process=False)
        # Not byte for byte: the last digit of a cosine is the machine's own, a float32's is not.
        np.testing.assert_allclose(again.vertices, kept.vertices, rtol=0, atol=1e-7)
        np.testing.assert_array_equal(again.faces, kept.faces)
        assert (BUNDLED / f"{name}.toml").read_text() == template_toml(form)

    def test_weighs_what_is_published_for_its_length(self, name):
        """A fish is about as dense as water: volume over length cubed is its condition factor."""
        form = body_forms()[name]
        volume = body_of(load_template(name)).volume
        assert volume == pytest.approx(form.condition, rel=0.35)


def test_every_body_form_is_bundled_with_its_source():
    assert bundled_names() == sorted(body_forms())
    assert all(form.source and form.condition_source for form in body_forms().values())


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

    @settings(max_examples=40, deadline=None)
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
            load_template(path), make_template(fish_mesh(), POINTS, name="expected")
        )

    def test_is_right_handed_so_that_no_body_becomes_its_mirror_image(self):
        template = make_template(fish_mesh(), POINTS, name="fish")
        assert body_of(template).volume > 0

    @pytest.mark.parametrize("suffix", [".ply", ".stl", ".off", ".glb"])
    def test_reads_any_mesh_that_trimesh_reads(self, tmp_path, suffix):
        # An STL repeats every vertex once a face: they have to be merged again.
        fish_mesh().export(tmp_path / f"fish{suffix}")
        (tmp_path / "fish.toml").write_text(toml(POINTS))
        template = load_template(tmp_path / f"fish{suffix}")
        expected = make_template(fish_mesh(), POINTS, name="fish")
        assert template.rest_vertices.shape == expected.rest_vertices.shape
        gap, _ = cKDTree(expected.rest_vertices).query(template.rest_vertices)
        assert gap.max() < 1e-6
        assert template.name == "fish"

    def test_closes_the_seams_of_a_texture(self, tmp_path):
        path = write_fish(tmp_path)
        text = path.read_text()
        corners = iter(range(1, 1000))

        def with_corner(line):
            places = [f"{v}/{next(corners)}" for v in line.split()[1:]]
            return "f " + " ".join(places)

        lines = [with_corner(s) if s.startswith("f") else s for s in text.splitlines()]
        textures = [f"vt 0.{k} 0.5" for k in range(1, 241)]
        path.write_text("\n".join(textures + lines))
        assert len(load_template(path).rest_vertices) == len(fish_mesh().vertices)


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


def moved(**points):
    return {key: np.array(value, np.float64) for key, value in {**POINTS, **points}.items()}


def holed():
    mesh = fish_mesh()
    return trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)


def one_face_flipped():
    mesh = fish_mesh()
    faces = np.array(mesh.faces)
    faces[0] = faces[0, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def with_nan():
    mesh = fish_mesh()
    vertices = np.array(mesh.vertices)
    vertices[3, 1] = np.nan
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


class TestRefusals:
    """Each says the file, what was expected and what came, in one line."""

    @staticmethod
    def assert_refused(path, match):
        with pytest.raises(TemplateError, match=match) as caught:
            load_template(path)
        assert "\n" not in str(caught.value)
        assert str(caught.value).startswith("template")

    @pytest.mark.parametrize(
        ("mesh", "match"),
        [
            (holed, "expected a closed mesh, got one with holes"),
            (one_face_flipped, "flipped faces"),
            (with_nan, "expected finite vertices, got NaN"),
            (lambda: trimesh.Trimesh(np.zeros((3, 3)), np.zeros((0, 3), int)), "empty"),
        ],
    )
    def test_mesh(self, tmp_path, mesh, match):
        self.assert_refused(write_fish(tmp_path, mesh=mesh()), match)

    def test_faces_of_vertices_that_are_not_there(self, tmp_path):
        path = write_fish(tmp_path)
        damaged = path.with_suffix(".ply")
        text = fish_mesh().export(file_type="ply", encoding="ascii").decode()
        first, _, last = text.rstrip().rpartition(" ")
        damaged.write_text(f"{first} {int(last) + 500_000}\n")
        self.assert_refused(damaged, "expected faces of its .* vertices, got others")

    @pytest.mark.parametrize(
        ("points", "match"),
        [
            (moved(joints=[[0, 0, 0]]), "expected two or more joints, got 1"),
            (moved(joints=np.zeros((0, 3))), "expected two or more joints, got 0"),
            (moved(joints=[[-0.1, 0, 0], [0.2, 0.5, 0]]), r"joint 2 .* 0\.\d\d body lengths off"),
            (moved(joints=[[0, 0, 0], [np.nan, 0, 0]]), "expected finite joints"),
            (moved(joints=[[0, 0], [0.1, 0], [0.2, 0]]), r"expected joints as \[x, y, z\]"),
            (moved(keypoints=[[-0.4, 0], [0, 0], [0.4, 0]]), r"expected keypoints as \[x, y, z\]"),
            (moved(keypoints=[[-900, 0, 0], [0, 0, 0], [0.4, 0, 0]]), "expected head on or in the"),
            (moved(keypoints=[[-0.4, 0, 0], [0, 0, 0.3], [0.4, 0, 0]]), "expected center on or in"),
            (moved(keypoints=[[-0.4, 0, 0], [0, 0, 0], [0.7, 0, 0]]), "expected tail on or in the"),
            (moved(keypoints=[[0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]]), "head and tail coincide"),
            (moved(keypoints=[[-0.4, 0, 0], [0, 0, 0], [np.inf, 0, 0]]), "expected finite keyp"),
        ],
    )
    def test_points(self, tmp_path, points, match):
        self.assert_refused(write_fish(tmp_path, points=points), match)

    @pytest.mark.parametrize(
        ("text", "match"),
        [
            ("joints = [[0", "expected TOML"),
            ("", r"\[keypoints\] lacks head, center, tail"),
            ("keypoints = 3", r"\[keypoints\] lacks head, center, tail"),
            (toml(POINTS).replace("center", "middle"), r"\[keypoints\] lacks center;"),
            (toml(POINTS).replace("joints", "bones"), "two or more joints, got 0"),
            ("joints = 3\n" + toml(POINTS).split("\n", 1)[1], "expected joints as"),
            ('joints = ["a", "b"]\n' + toml(POINTS).split("\n", 1)[1], "expected joints as"),
        ],
    )
    def test_toml(self, tmp_path, text, match):
        path = write_fish(tmp_path)
        path.with_suffix(".toml").write_text(text)
        self.assert_refused(path, match)

    def test_toml_that_is_no_text(self, tmp_path):
        path = write_fish(tmp_path)
        path.with_suffix(".toml").write_bytes(b"\xff\xfe\x00")
        self.assert_refused(path, "expected TOML")

    def test_missing_toml(self, tmp_path):
        path = write_fish(tmp_path)
        path.with_suffix(".toml").unlink()
        self.assert_refused(path, r"fish\.toml beside the mesh.*it is missing")

    @pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".glb", ".docx", ""])
    @pytest.mark.parametrize("content", [b"", b"\x00\x01not a mesh\xff" * 20])
    def test_unreadable_file(self, tmp_path, suffix, content):
        (tmp_path / f"fish{suffix}").write_bytes(content)
        (tmp_path / "fish.toml").write_text(toml(POINTS))
        self.assert_refused(tmp_path / f"fish{suffix}", "expected (a|one) mesh")

    def test_point_cloud(self, tmp_path):
        trimesh.PointCloud(fish_mesh().vertices).export(tmp_path / "fish.ply")
        self.assert_refused(tmp_path / "fish.ply", "expected one mesh with faces")

    @pytest.mark.parametrize("name", ["herring", "no/such/mesh.ply", "."])
    def test_unknown_name(self, name):
        self.assert_refused(name, "one of bream, cod, eel, halibut, pike, salmon, tuna;")
