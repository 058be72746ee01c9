"""The space of shapes: what coefficients do to a mesh, what they leave, and what is likely."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial import cKDTree

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.shape.space import (
    BREADTH,
    LEFT,
    LOBES,
    MEAN_THICKNESS,
    NUM_COEFFICIENTS,
    RIGHT,
    THICKNESS,
    TRUNK,
    coefficients_of,
    directions,
    form_precision,
    half_section,
    individual_covariance,
    reshaped,
    roundness,
    std_of,
    with_std_of,
)
from stream_dmr.template.template_file import bundled_names, load_template
from tests.support.shapes import fish_template

HALIBUT, SALMON = load_template("halibut"), load_template("salmon")
ZEROS = np.zeros(NUM_COEFFICIENTS)
vectors = arrays.arrays(float, NUM_COEFFICIENTS, elements=st.floats(-0.03, 0.03))


def only(part, value):
    """Coefficients that are zero but for one part."""
    coefficients = ZEROS.copy()
    coefficients[part] = value
    return coefficients


def test_zeros_leave_a_template_as_it_is():
    same = reshaped(HALIBUT, ZEROS)
    np.testing.assert_allclose(same.rest_vertices, HALIBUT.rest_vertices, atol=1e-15)


@given(vector=vectors)
def test_what_lengths_depend_on_stays(vector):
    other = reshaped(HALIBUT, vector)
    for field in ("keypoints", "joints", "midline", "faces"):
        assert getattr(other, field) is getattr(HALIBUT, field)


@given(breadth=st.floats(-0.3, 0.3), thickness=st.floats(-0.3, 0.3))
def test_factors_of_all_knots_scale_the_cross_sections(breadth, thickness):
    other = reshaped(HALIBUT, only(BREADTH, breadth) + only(THICKNESS, thickness))
    factors = np.exp([0.0, breadth, thickness])
    np.testing.assert_allclose(other.rest_vertices, HALIBUT.rest_vertices * factors, atol=1e-12)


@pytest.mark.parametrize(("part", "side"), [(LEFT, 1), (RIGHT, -1)])
def test_sides_are_scaled_by_themselves(part, side):
    moved = reshaped(HALIBUT, only(part, 0.2)).rest_vertices
    is_own = side * HALIBUT.rest_vertices[:, 1] > 0
    np.testing.assert_allclose(moved[~is_own], HALIBUT.rest_vertices[~is_own], atol=1e-15)
    expected = HALIBUT.rest_vertices[is_own, 1] * np.exp(0.2)
    np.testing.assert_allclose(moved[is_own, 1], expected, atol=1e-12)


def test_lobes_move_the_tail_s_corners_and_not_its_middle():
    moved = reshaped(SALMON, only(LOBES, 0.02))
    shift = (moved.rest_vertices - SALMON.rest_vertices)[:, 0]
    assert shift.max() == pytest.approx(0.02)
    assert not shift[np.abs(SALMON.rest_vertices[:, 1]) < 1e-6].any()
    assert SALMON.total_per_fork is not None
    assert moved.total_per_fork == pytest.approx(SALMON.total_per_fork + 0.02)


@given(vector=vectors)
def test_one_shape_and_its_opposite_give_the_template_again(vector):
    vector[LOBES] = 0.0  # which moves the places along the midline that the others depend on
    again = reshaped(reshaped(HALIBUT, vector), -vector)
    np.testing.assert_allclose(again.rest_vertices, HALIBUT.rest_vertices, atol=1e-12)


@pytest.mark.parametrize("template", [HALIBUT, fish_template(subdivisions=2)])
def test_directions_are_finite_differences_of_reshaped(template):
    slopes, step = directions(Body.from_template(template)), 1e-6
    for n, way in enumerate(np.eye(NUM_COEFFICIENTS)):
        more, less = (reshaped(template, s * way).rest_vertices for s in (step, -step))
        # Places are segments of the midline there, lengths along it here.
        np.testing.assert_allclose(slopes[:, :, n], (more - less) / (2 * step), atol=5e-4)


@pytest.mark.parametrize("base", ["cod", "halibut"])
@pytest.mark.parametrize("name", bundled_names())
def test_every_bundled_form_is_in_the_space(name, base):
    """But for what lies between knots, within 1.5 % of a body length."""
    template, form = load_template(base), load_template(name)
    found = reshaped(template, coefficients_of(form, template))
    gap, _ = cKDTree(form.rest_vertices).query(found.rest_vertices)
    assert gap.max() < 0.015


def test_meshes_of_other_rings_are_refused():
    with pytest.raises(ValueError, match="expected two meshes of the same rings"):
        coefficients_of(fish_template(), HALIBUT)


@pytest.mark.parametrize("matrix", [form_precision(), individual_covariance()])
def test_what_is_likely_is_a_proper_gaussian(matrix):
    np.testing.assert_allclose(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > 0


def test_a_stock_is_taken_to_be_broader_or_slimmer_than_its_form_by_a_tenth_and_more():
    std = np.sqrt(TRUNK @ np.linalg.inv(form_precision()) @ TRUNK)
    assert 0.1 < std < 0.4
    assert np.sqrt(TRUNK @ individual_covariance() @ TRUNK) == pytest.approx(0.05, rel=0.1)
    assert TRUNK.sum() == pytest.approx(1.0)


def moved_in_memory(array):
    """The same numbers, a byte off any boundary, as a recording's bytes may lie."""
    room = np.zeros(array.nbytes + 1, np.uint8)
    moved = np.frombuffer(room.data, np.float64, array.size, offset=1).reshape(array.shape)
    room[1:] = np.frombuffer(np.ascontiguousarray(array).tobytes(), np.uint8)
    return moved


def test_a_recorded_shape_is_the_run_s_to_the_last_bit():
    """Wherever and in whichever order its numbers lie in memory: BLAS would round otherwise."""
    rng, template = np.random.default_rng(5), load_template("cod")
    covariance = np.linalg.inv(form_precision())
    for order in (np.asfortranarray, moved_in_memory):
        assert std_of(TRUNK, order(covariance)) == std_of(TRUNK, covariance)
    for _ in range(20):
        coefficients = rng.normal(0, 0.2, NUM_COEFFICIENTS)
        again = reshaped(template, moved_in_memory(coefficients)).rest_vertices
        np.testing.assert_array_equal(again, reshaped(template, coefficients).rest_vertices)


@pytest.mark.parametrize(("part", "mean"), [(BREADTH, TRUNK), (THICKNESS, MEAN_THICKNESS)])
def test_only_the_std_of_a_mean_is_set(part, mean):
    covariance = np.linalg.inv(form_precision())
    known = with_std_of(covariance, part, mean, 0.03)
    assert std_of(mean, known) == pytest.approx(0.03)
    assert np.linalg.eigvalsh(known).min() > -1e-12
    differences = np.eye(NUM_COEFFICIENTS)[part][:-1] - np.eye(NUM_COEFFICIENTS)[part][1:]
    np.testing.assert_allclose(
        differences @ known @ differences.T, differences @ covariance @ differences.T, atol=1e-12
    )


def test_roundness_is_thickness_over_breadth():
    template = load_template("cod")
    breadth, thickness = half_section(template)
    assert roundness(template) == pytest.approx(thickness / breadth)
    wide = np.zeros(NUM_COEFFICIENTS)
    wide[BREADTH] = np.log(2)
    assert roundness(reshaped(template, wide)) == pytest.approx(roundness(template) / 2)
