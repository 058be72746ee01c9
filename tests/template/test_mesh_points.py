"""Head, center, tail and joints, found from the shape of a mesh alone."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stream_dmr.errors import TemplateError
from stream_dmr.template.fish_outline import find_points
from stream_dmr.template.template_file import bundled_names, load_template
from tests.support.shapes import seeds


@given(name=st.sampled_from(bundled_names()), seed=seeds, scale=st.floats(1e-2, 1e4))
@settings(max_examples=10)
def test_finds_the_points_of_every_body_form_in_any_unit_and_orientation(
    name: str, seed: int, scale: float
):
    template = load_template(name)
    rng = np.random.default_rng(seed)
    rotation, shift = Rotation.random(rng=rng), rng.normal(size=3)
    vertices = scale * (rotation.apply(template.rest_vertices) + shift)
    points = find_points(trimesh.Trimesh(vertices, template.faces, process=False), name=name)
    for key, expected in (("keypoints", template.keypoints), ("joints", template.joints)):
        found = rotation.inv().apply(points[key] / scale - shift)
        np.testing.assert_allclose(found, expected, atol=0.003)


def test_pectoral_fins_that_stand_out_do_not_hide_the_tail_fin():
    template = load_template("tuna")
    body = trimesh.Trimesh(template.rest_vertices, template.faces, process=False)
    fins = trimesh.creation.box((0.12, 0.02, 0.6))
    fins.apply_translation([-0.1, 0.0, 0.0])
    points = find_points(trimesh.boolean.union([body, fins]), name="flying tuna")
    np.testing.assert_allclose(points["keypoints"], template.keypoints, atol=0.01)


@pytest.mark.parametrize(
    "shape",
    [
        trimesh.creation.icosphere(),
        trimesh.creation.box((3.0, 2.0, 1.0)),
        trimesh.creation.cylinder(radius=0.01, height=3.0),
    ],
    ids=["sphere", "box", "stick"],
)
def test_what_is_no_fish_is_refused_in_one_line(shape: trimesh.Trimesh):
    with pytest.raises(TemplateError, match="template x: expected a fish") as refusal:
        find_points(shape, name="x")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "head_z", "fork_z"), [("BigFishA", 9.9, -9.3), ("MediumFishB", 2.2, -2.0)]
)
def test_a_low_polygon_mesh_is_taken_as_it_is(real: Path, name: str, head_z: float, fork_z: float):
    """Models of a game: open, of many parts, fins without thickness, no TOML."""
    path = real / "meshes" / f"{name}.obj"
    notices: list[str] = []
    template = load_template(path, on_notice=notices.append)
    assert len(notices) == 2
    length = head_z - fork_z
    assert f"{name}.toml: head found at [" in notices[1]
    assert np.ptp(template.keypoints[:, 0]) == pytest.approx(1.0, abs=0.01)
    assert np.ptp(template.rest_vertices[:, 0]) == pytest.approx(
        np.ptp(trimesh.load_mesh(path).vertices[:, 2]) / length, rel=0.03
    )
