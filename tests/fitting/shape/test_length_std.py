"""How uncertain lengths are by the shape: known answers for slant that a breadth hides."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.length_std import freed, slant_std_ratio


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
