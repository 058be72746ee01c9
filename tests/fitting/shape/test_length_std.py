"""How uncertain lengths are by the shape: known answers for slant that a breadth hides."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.fitting.body import MeshLevels
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.solver.problem import SCALE, Problem
from stream_dmr.fitting.target import Target
from stream_dmr.fitting.uncertainty import form_std_ratio, freed, slant_std_ratio
from stream_dmr.template.template_file import load_template
from tests.support.shapes import crop_from_mask


def test_with_a_known_breadth_no_slant_is_hidden():
    assert slant_std_ratio(0.0, slant_std_rad=0.25, breadth_std=1e-4) < 2e-3


def test_with_an_unknown_breadth_the_prior_of_the_slant_remains():
    """-log cos t is t^2 / 2 nearly, whose std is s^2 / sqrt(2) for t ~ N(0, s)."""
    std = slant_std_ratio(0.0, slant_std_rad=0.2, breadth_std=10.0)
    assert std == pytest.approx(0.2**2 / np.sqrt(2), rel=0.1)


@given(slant_std=st.floats(0.05, 0.4), breadth_std=st.floats(0.02, 0.2))
def test_less_is_known_with_a_less_known_breadth(slant_std, breadth_std):
    less, more = (
        slant_std_ratio(0.0, slant_std_rad=slant_std, breadth_std=factor * breadth_std)
        for factor in (0.5, 1.0)
    )
    assert 0 <= less <= more


def test_joints_are_as_free_as_the_breadth_is_unknown():
    settings = FitMeshSettings()
    assert freed(settings, 0.0) == settings
    variance = settings.nat / (2 * settings.lambda_scale)
    loose = freed(settings, 0.1**2)
    assert settings.nat / (2 * loose.lambda_scale) == pytest.approx(variance + 0.1**2)
    for fixed in ({"lambda_scale": 0.0}, {"prior_weight": 0.0}):
        kept = settings.model_copy(update=fixed)
        assert freed(kept, 0.1**2) == kept


def test_joints_are_as_free_as_a_shift_of_the_edge_makes_the_breadth_unknown():
    """A bar 8 px broad whose edge may be 0.4 px off is known to a tenth in breadth."""
    mask = np.zeros((128, 128), bool)
    mask[60:68, 4:124] = True
    settings = FitMeshSettings(edge_shift_px=0.4)
    body = MeshLevels.from_template(load_template("halibut"), max_faces=600).coarse
    target = Target.from_crop(crop_from_mask(mask), plane_normal=np.array([0.0, 0.0, 1.0]))
    fine, half, firm = (
        Problem.from_settings(chosen, body, seen, with_smoothness=False).lambdas[SCALE]
        for chosen, seen in (
            (settings, target),
            (settings, target.coarse()),
            (settings.model_copy(update={"edge_shift_px": 0.0}), target),
        )
    )
    assert fine == half < firm == settings.lambda_scale
    nat, variance = settings.nat, settings.nat / (2 * firm)
    assert nat / (2 * fine) == pytest.approx(variance + 0.1**2, rel=0.15)


@pytest.mark.parametrize("changes", [{"prior_weight": 0.0}, {"lambda_scale": 0.0}])
def test_the_papers_loss_has_its_own_weights(changes):
    settings = FitMeshSettings(**changes)
    body = MeshLevels.from_template(load_template("halibut"), max_faces=600).coarse
    mask = np.zeros((64, 64), bool)
    mask[28:36, 4:60] = True
    target = Target.from_crop(crop_from_mask(mask), plane_normal=np.array([0.0, 0.0, 1.0]))
    problem = Problem.from_settings(settings, body, target, with_smoothness=True)
    np.testing.assert_array_equal(problem.lambdas, settings.lambdas())


def test_where_the_form_is_certain_the_choice_adds_nothing():
    sizes = np.log([1.0, 1.2, 0.7])
    assert form_std_ratio(sizes, np.array([0.0, np.inf, 60.0])) == pytest.approx(0, abs=1e-9)


def test_two_forms_that_masks_prefer_alike_make_a_length_as_uncertain_as_they_differ():
    sizes = np.array([0.0, 0.12, 5.0])
    assert form_std_ratio(sizes, np.array([3.0, 3.0, np.inf])) == pytest.approx(0.06)


@given(nats=st.floats(0, 10), more=st.floats(0, 10))
def test_the_surer_the_form_the_surer_the_length(nats, more):
    sizes = np.array([0.0, 0.1])
    less_sure, surer = (
        form_std_ratio(sizes, np.array([0.0, against])) for against in (nats, nats + more)
    )
    assert surer <= less_sure + 1e-12
