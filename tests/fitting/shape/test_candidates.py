"""Candidate shapes: their shares, their way through a recording, and what --template means."""

from dataclasses import fields, replace

import numpy as np
import pytest

from stream_dmr.fitting.shape.candidates import (
    CandidateShape,
    CandidateShapes,
    describe,
    load_shapes,
    mesh_form,
)
from stream_dmr.fitting.shape.space import BREADTH, NUM_COEFFICIENTS, THICKNESS, reshaped
from stream_dmr.recording.codec import decode, encode
from stream_dmr.template.template_file import bundled_names, load_template, save_template
from tests.support.recorded_run import header
from tests.support.shapes import STRAIGHT, fish_template

TEMPLATE, FORMS = load_shapes("auto", are_lying=True)


def assert_equal(some: CandidateShapes, other: CandidateShapes) -> None:
    for field in fields(CandidateShapes):
        one, two = getattr(some, field.name), getattr(other, field.name)
        np.testing.assert_array_equal(one, two, err_msg=field.name)


def test_auto_takes_every_body_form_for_as_likely():
    assert [form.name for form in FORMS] == bundled_names()
    np.testing.assert_allclose(FORMS.shares, 1 / len(bundled_names()))
    assert not FORMS.are_learnt


def test_the_deepest_form_is_one_of_those_of_lying_fish_or_named():
    without = [name for name in bundled_names() if name != "spadefish"]
    for name, expected in (("auto", without), ("cod", without), ("spadefish", bundled_names())):
        assert [form.name for form in load_shapes(name)[1]] == expected


def test_a_named_form_gets_the_largest_share_and_the_others_keep_some():
    _, shapes = load_shapes("pike")
    by_name = {form.name: form.share for form in shapes}
    others = [share for name, share in by_name.items() if name != "pike"]
    assert sum(by_name.values()) == pytest.approx(1.0)
    assert by_name["pike"] > 10 * max(others)
    assert min(others) > 0


def test_a_mesh_is_taken_at_its_word(tmp_path):
    save_template(fish_template(points=STRAIGHT), tmp_path / "own.ply", comment="a test's")
    template, shapes = load_shapes(str(tmp_path / "own.ply"))
    assert shapes is None
    assert len(template.rest_vertices) == len(fish_template().rest_vertices)


def test_a_mesh_as_the_only_form_has_no_difference_from_itself():
    (form,) = mesh_form(fish_template())
    assert (form.name, form.share) == ("fish", 1.0)
    assert not form.coefficients.any()


def test_they_come_through_a_recording_s_header_as_they_were():
    assert_equal(decode(CandidateShapes, encode(FORMS)), FORMS)
    run = replace(header(), candidates=FORMS)
    again = type(run).from_parts(run.metadata(), run.attachments())
    assert again.candidates is not None
    assert_equal(again.candidates, FORMS)


def test_a_recording_of_before_has_none():
    run = header()
    assert "shapes.pb" not in run.attachments()
    assert type(run).from_parts(run.metadata(), run.attachments()).candidates is None


@pytest.mark.parametrize(
    ("breadth", "thickness", "words"),
    [
        (0.1, -0.2, "30% of the fish: like cod, 11% broader (+-5%), 18% thinner"),
        (-0.1, 0.01, "30% of the fish: like cod, 10% slimmer (+-5%), neither thicker nor thinner"),
    ],
)
def test_a_stock_is_described_by_how_it_differs_from_its_form(breadth, thickness, words):
    cod = next(form for form in FORMS if form.name == "cod")
    coefficients = cod.coefficients.copy()
    coefficients[BREADTH] += breadth
    coefficients[THICKNESS] += thickness
    # Of one breadth for all knots, so that the trunk's std is that of each.
    covariance = np.full((NUM_COEFFICIENTS, NUM_COEFFICIENTS), 0.05**2)
    stocks = CandidateShapes.of(
        [CandidateShape("cod", coefficients, covariance, 0.3)], are_learnt=True
    )
    assert list(describe(FORMS, stocks)) == [words]


def test_the_base_form_is_itself():
    cod = next(form for form in FORMS if form.name == "cod")
    np.testing.assert_allclose(
        reshaped(TEMPLATE, cod.coefficients).rest_vertices,
        load_template("cod").rest_vertices,
        atol=1e-9,
    )
