"""Learnt proportions: of known bodies; and what a learnt template keeps."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.optimize import check_grad

from stream_dmr.errors import TemplateError
from stream_dmr.fitting.paper.skinning import Rig
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.shape.learn import Sample, _Crowd, _unlikeliness, learn, well_seen
from stream_dmr.fitting.shape.proportions import NUM_KNOTS, Proportions
from stream_dmr.fitting.target import Target
from stream_dmr.localization.localize import LocalizeSettings, localize
from stream_dmr.template.template import load_template, save_template, simplified
from tests.support.shapes import crop_of, pose

HALIBUT = load_template("halibut")
SIZE = 2 * NUM_KNOTS + 2
SETTINGS = FitMeshSettings()
TOWARD_CAMERA = np.array([0.0, 0.0, 1.0])
vectors = arrays.arrays(float, SIZE, elements=st.floats(-0.03, 0.03))


def samples_of(template, *, num_fish):
    """Frames of fish of these proportions, in poses that are known to some degree."""
    rng, rig = np.random.default_rng(11), Rig.from_template(template)
    samples = []
    for fish in range(num_fish):
        flat = pose(rng, in_plane_rad=rng.uniform(-np.pi, np.pi))
        target = Target.from_crop(crop_of(flat, rig, size=128), plane_normal=TOWARD_CAMERA)
        samples.append(Sample((0, fish), 0.0, target, flat[0].numpy()))
    return samples


class TestProportions:
    def test_none_leave_a_template_as_it_is(self):
        same = Proportions.from_vector(np.zeros(SIZE)).apply(HALIBUT)
        np.testing.assert_allclose(same.rest_vertices, HALIBUT.rest_vertices, atol=1e-15)

    @given(vector=vectors)
    def test_what_lengths_depend_on_stays(self, vector):
        other = Proportions.from_vector(vector).apply(HALIBUT)
        for field in ("keypoints", "joints", "midline", "faces"):
            assert getattr(other, field) is getattr(HALIBUT, field)

    @given(width=st.floats(-0.3, 0.3), thickness=st.floats(-0.3, 0.3))
    def test_factors_of_all_knots_scale_the_cross_sections(self, width, thickness):
        vector = np.full(SIZE, width)
        vector[-2:] = thickness, 0.0
        other = Proportions.from_vector(vector).apply(HALIBUT)
        factors = [1.0, np.exp(width), np.exp(thickness)]
        np.testing.assert_allclose(other.rest_vertices, HALIBUT.rest_vertices * factors, atol=1e-12)

    def test_sides_are_scaled_apart(self):
        vector = np.zeros(SIZE)
        vector[:NUM_KNOTS] = 0.2
        moved = Proportions.from_vector(vector).apply(HALIBUT).rest_vertices
        left = HALIBUT.rest_vertices[:, 1] > 0
        np.testing.assert_allclose(moved[~left], HALIBUT.rest_vertices[~left], atol=1e-15)
        assert (moved[left, 1] > HALIBUT.rest_vertices[left, 1]).all()

    def test_lobes_move_the_tail_s_corners_and_not_its_middle(self):
        vector = np.zeros(SIZE)
        vector[-1] = 0.02
        moved = Proportions.from_vector(vector).apply(HALIBUT).rest_vertices
        shift = (moved - HALIBUT.rest_vertices)[:, 0]
        assert shift.max() == pytest.approx(0.02)
        assert not shift[np.abs(HALIBUT.rest_vertices[:, 1]) < 1e-6].any()


class TestLearning:
    def test_slope_is_that_of_the_likelihood(self):
        """Poses are held, as the envelope theorem allows."""
        crowd = _Crowd(HALIBUT, samples_of(HALIBUT, num_fish=2), SETTINGS)
        vector = np.random.default_rng(0).normal(size=SIZE) * 0.02
        crowd.nats(vector)
        slope = crowd.slope(vector)
        error = check_grad(crowd._nats_as_posed, lambda _: slope, vector, epsilon=1e-4)
        assert error < 0.05 * np.linalg.norm(slope)

    def test_finds_a_wider_stock(self):
        """A tenth wider behind the head, a tenth narrower before the tail."""
        few_faces = simplified(HALIBUT, max_faces=600)
        vector = np.zeros(SIZE)
        truth = 0.1 * np.cos(np.linspace(0, np.pi, NUM_KNOTS))
        vector[:NUM_KNOTS] = vector[NUM_KNOTS:-2] = truth
        stock = Proportions.from_vector(vector).apply(few_faces)
        samples = samples_of(stock, num_fish=4)
        learnt = learn(few_faces, samples, SETTINGS)
        middle = slice(2, NUM_KNOTS - 2)
        found = (learnt.proportions.left + learnt.proportions.right) / 2
        np.testing.assert_allclose(found[middle], truth[middle], atol=0.04)
        assert learnt.iou[1] > learnt.iou[0]

    @pytest.mark.slow
    def test_template_s_own_fish_change_little(self):
        learnt = learn(HALIBUT, samples_of(HALIBUT, num_fish=8), SETTINGS)
        assert np.abs(learnt.proportions.left[2:-2]).max() < 0.03
        assert abs(learnt.size_change) < 0.01

    def test_nothing_known_is_likelier_than_the_template(self):
        assert _unlikeliness(np.zeros(SIZE)) == 0.0

    def test_too_few_fish_are_refused(self):
        def localized(mesh, calibration):
            return localize(mesh, settings=LocalizeSettings(), calibration=calibration)

        with pytest.raises(TemplateError, match="expected 5 or more fish"):
            well_seen([([], None)], HALIBUT, SETTINGS, localized)


@given(vector=vectors)
def test_a_saved_template_is_read_again(tmp_path_factory, vector):
    path = tmp_path_factory.mktemp("learnt") / "local.ply"
    template = Proportions.from_vector(vector).apply(
        replace(HALIBUT, tail_gives="fork", total_per_fork=1.03)
    )
    save_template(template, path, comment="learnt from a test")
    again = load_template(path)
    for field in ("keypoints", "joints", "midline", "rest_vertices"):
        np.testing.assert_allclose(getattr(again, field), getattr(template, field), atol=1e-6)
    assert (again.tail_gives, again.total_per_fork) == ("fork", 1.03)
