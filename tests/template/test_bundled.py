"""The bundled templates: what their tables and their maker promise."""

import numpy as np
import pytest
import trimesh

from stream_dmr.geometry import arc_length
from stream_dmr.template.make_bundled import body_mesh, template_toml
from stream_dmr.template.template import load_body_forms
from stream_dmr.template.template_file import BUNDLED, bundled_names, load_template
from tests.support.template_files import body_of


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
        assert thin < broad < 0.7

    def test_is_what_its_script_makes(self, name, tmp_path):
        form = load_body_forms()[name]
        body_mesh(form).export(tmp_path / "again.ply")
        again = trimesh.load_mesh(tmp_path / "again.ply", process=False)
        kept = trimesh.load_mesh(BUNDLED / f"{name}.ply", process=False)
        # Not byte for byte: the last digit of a cosine is the machine's own, a float32's is not.
        np.testing.assert_allclose(again.vertices, kept.vertices, rtol=0, atol=1e-7)
        np.testing.assert_array_equal(again.faces, kept.faces)
        assert (BUNDLED / f"{name}.toml").read_text() == template_toml(form)

    def test_weighs_what_is_published_for_its_length(self, name):
        """A fish is about as dense as water: volume over length cubed is its condition factor."""
        form = load_body_forms()[name]
        volume = body_of(load_template(name)).volume
        assert volume == pytest.approx(form.condition, rel=0.35)


def test_every_body_form_is_bundled_with_its_source():
    assert bundled_names() == sorted(load_body_forms())
    assert all(form.source and form.condition_source for form in load_body_forms().values())
