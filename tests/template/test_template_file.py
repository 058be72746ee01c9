"""Reading and writing template files: meshes of any format, TOMLs, and what is refused."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from stream_dmr.errors import OutputError, TemplateError
from stream_dmr.template.template import canonical_template
from stream_dmr.template.template_file import load_template, save_template
from tests.support.shapes import POINTS, fish_mesh, fish_template
from tests.support.small_disk import file_size_limit
from tests.support.template_files import toml, write_fish


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".off", ".glb"])
def test_reads_any_mesh_that_trimesh_reads(tmp_path, suffix):
    # An STL repeats every vertex once a face: they have to be merged again.
    fish_mesh().export(tmp_path / f"fish{suffix}")
    (tmp_path / "fish.toml").write_text(toml(POINTS))
    template = load_template(tmp_path / f"fish{suffix}")
    expected = canonical_template(fish_mesh(), POINTS, name="fish")
    assert template.rest_vertices.shape == expected.rest_vertices.shape
    gap, _ = cKDTree(expected.rest_vertices).query(template.rest_vertices)
    assert gap.max() < 1e-6
    assert template.name == "fish"


def test_closes_the_seams_of_a_texture(tmp_path):
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


def test_reads_a_draco_compressed_gltf(tmp_path):
    path = tmp_path / "fish.glb"
    path.write_bytes(
        trimesh.exchange.gltf.export_glb(
            trimesh.Scene(fish_mesh(subdivisions=2)), extension_draco=True
        )
    )
    assert b"KHR_draco_mesh_compression" in path.read_bytes()
    (tmp_path / "fish.toml").write_text(toml(POINTS))
    notices: list[str] = []
    template = load_template(path, on_notice=notices.append)
    expected = fish_template(subdivisions=2)
    gap, _ = cKDTree(expected.rest_vertices).query(template.rest_vertices)
    assert gap.max() < 1e-4  # 14 bits a coordinate
    assert notices == []


def test_a_mesh_with_a_hole_is_repaired_and_says_so(tmp_path):
    mesh = fish_mesh()
    holed = trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)
    notices: list[str] = []
    template = load_template(write_fish(tmp_path, mesh=holed), on_notice=notices.append)
    assert len(notices) == 1
    assert "fish.obj: repaired: open parts closed by filling their holes: 1" in notices[0]
    assert len(template.faces) == len(mesh.faces) + 2  # a fan of three for the one


def test_without_a_toml_the_points_are_found_and_told(tmp_path):
    path = write_fish(tmp_path, mesh=fish_mesh(subdivisions=3))
    expected = load_template(path)
    path.with_suffix(".toml").unlink()
    notices: list[str] = []
    template = load_template(path, on_notice=notices.append)
    assert len(notices) == 1
    assert "fish.toml: head found at [-0.500" in notices[0]
    assert np.ptp(template.rest_vertices[:, 0]) < np.ptp(expected.rest_vertices[:, 0])
    assert template.tail_gives is None


def test_a_mesh_of_many_faces_is_taken_and_told(tmp_path):
    notices: list[str] = []
    load_template(write_fish(tmp_path, mesh=fish_mesh(subdivisions=5)), on_notice=notices.append)
    assert len(notices) == 1
    assert "its 20480 faces make runs slow" in notices[0]


def test_what_is_saved_is_what_is_read(tmp_path):
    template = load_template("tuna")
    save_template(template, tmp_path / "again.ply", comment="a copy")
    again = load_template(tmp_path / "again.ply")
    assert (again.name, again.tail_gives, again.total_per_fork) == ("again", "fork", 1.06)
    for field in ("rest_vertices", "keypoints", "joints", "midline"):
        np.testing.assert_allclose(getattr(again, field), getattr(template, field), atol=1e-7)
    np.testing.assert_array_equal(again.faces, template.faces)


def moved(**points):
    return {key: np.array(value, np.float64) for key, value in {**POINTS, **points}.items()}


def with_nan():
    mesh = fish_mesh()
    vertices = np.array(mesh.vertices)
    vertices[3, 1] = np.nan
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def thin(share):
    mesh = fish_mesh()
    return trimesh.Trimesh(mesh.vertices * [1.0, 1.0, share], mesh.faces, process=False)


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
            (with_nan, "expected finite vertices, got NaN"),
            (lambda: trimesh.Trimesh(np.zeros((3, 3)), np.zeros((0, 3), int)), "empty"),
            (lambda: thin(1e-4), "expected a body, got a flat mesh"),
            (lambda: thin(0.0), "expected a body, got a flat mesh"),
            (lambda: trimesh.Trimesh(np.eye(2, 3), [[0, 1, 1]], process=False), "got a flat mesh"),
            (lambda: trimesh.creation.box(fish_mesh().extents), "got none within 0.1 body lengths"),
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
            (
                {name: given / 1000 for name, given in POINTS.items()},
                "times as long as they are",
            ),
            (moved(joints=[[0.1, 0, 0], [0.1, 0, 0]]), "two joints coincide"),
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
        self.assert_refused(name, "one of bream, cod, eel, halibut, pike, salmon, spadefish, tuna;")


def test_a_full_disk_leaves_the_template_that_was_there(tmp_path):
    save_template(fish_template(), tmp_path / "own.ply", comment="a test's")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with file_size_limit(1000), pytest.raises(OutputError, match="too large"):
        save_template(fish_template(), tmp_path / "own.ply", comment="another")
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
